"""Our source address on a bus with others that want it: can-j1939 as claimant on the same virtual bus."""

import time
from collections.abc import Callable, Iterator

import can
import pytest
from j1939 import ControllerApplication, ElectronicControlUnit, Name

from fakes import Bench, Notes, drive_messages
from soilbus.can.dbc_files import output_database
from soilbus.can.j1939 import name_of
from soilbus.config.model import J1939, ConfigError
from soilbus.daemon.address_claim import AddressClaim
from soilbus.simulator.reference import reference_configuration

ADDRESS = 0x9A
OURS = J1939(address_claim=True, manufacturer_code=1000, identity_number=7)
CLAIM, CANNOT_CLAIM, REQUEST = 0x18EEFF00 | ADDRESS, 0x18EEFFFE, 0x18EAFFF9
PATIENCE = 5.0
"""Time [s] after which a test gives up waiting."""


class OnBus:
    """A claim of ours on a virtual bus, driven as the loop drives it; keeps what it sent."""

    def __init__(self, channel: str, settings: J1939 = OURS) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel, can_filters=list(AddressClaim.filters))
        self.claim = AddressClaim(settings, ADDRESS)
        self.sent: list[tuple[int, bytes]] = []

    def until(self, condition: Callable[[], bool]) -> bool:
        end = time.monotonic() + PATIENCE
        while not condition() and time.monotonic() < end:
            if (message := self.bus.recv(0.005)) is not None:
                self.claim.hear(message.timestamp, message.arbitration_id, message.is_extended_id, message.data)
            for frame in self.claim.outgoing():
                self.sent.append((frame.arbitration_id, frame.data))
                self.bus.send(can.Message(arbitration_id=frame.arbitration_id, data=frame.data))
        return condition()


@pytest.fixture
def ours(request) -> Iterator[OnBus]:
    on_bus = OnBus(request.node.name)
    yield on_bus
    on_bus.claim.close()
    on_bus.bus.shutdown()


@pytest.fixture
def other(request) -> Iterator[Callable[[int], ControllerApplication]]:
    """Another claimant of the same address, by its identity number: the smaller NAME wins."""
    unit = ElectronicControlUnit()
    unit.connect(interface="virtual", channel=request.node.name)

    def claimant(identity: int) -> ControllerApplication:
        rival = OURS.model_copy(update={"identity_number": identity})
        application = ControllerApplication(Name(value=name_of(rival)), ADDRESS)
        unit.add_ca(controller_application=application)
        application.start()
        return application

    yield claimant
    unit.disconnect()
    unit.stop()


def test_the_name_is_that_of_the_standard():
    name = Name(
        arbitrary_address_capable=False, industry_group=2, vehicle_system_instance=0, vehicle_system=17,
        function=255, function_instance=0, ecu_instance=0, manufacturer_code=1000, identity_number=7,
    )  # fmt: skip
    assert name_of(OURS) == name.value


def test_alone_it_claims_waits_and_holds(ours):
    assert ours.claim.status() == "address 0x9a not claimed yet"
    assert ours.until(lambda: bool(ours.sent))
    assert ours.sent == [(CLAIM, name_of(OURS).to_bytes(8, "little"))]
    assert not ours.claim.holds  # it may be contested
    assert ours.until(lambda: ours.claim.holds)
    assert ours.claim.status() == ""


def test_a_request_is_answered_with_the_claim(ours):
    assert ours.until(lambda: ours.claim.holds)
    ours.claim.hear(1.0, REQUEST, True, bytes.fromhex("00EE00"))
    assert ours.until(lambda: len(ours.sent) == 2)
    assert ours.sent[0] == ours.sent[1]


def test_a_node_with_a_smaller_name_takes_it(ours, other):
    assert ours.until(lambda: ours.claim.holds)
    rival = other(6)
    assert ours.until(lambda: rival.state == rival.State.NORMAL)
    assert ours.claim.is_lost
    assert not ours.claim.holds
    assert ours.sent[-1][0] == CANNOT_CLAIM
    assert "belongs to a node with a smaller NAME" in ours.claim.status()


def test_an_echo_of_our_own_claim_is_no_contender(ours):
    assert ours.until(lambda: ours.claim.holds)
    for identifier, data in tuple(ours.sent):
        ours.claim.hear(1.0, identifier, True, data)
    assert list(ours.claim.outgoing()) == []
    assert ours.claim.holds


def wait_until_held(claim: AddressClaim) -> None:
    """Let the time pass in which a claim may be contested, which is can-j1939's own."""
    end = time.monotonic() + PATIENCE
    while not claim.holds and time.monotonic() < end:
        time.sleep(0.01)
    assert claim.holds


def of_ours(bench: Bench, since: float = 0.0) -> list[float]:
    """When our frames other than those of the claim went out, by the bus's time [s]."""
    times = [(t, m) for t, m in bench.wire.sent if m.arbitration_id not in (CLAIM, CANNOT_CLAIM) and t >= since]
    return [t + bench.wire.offset for t, _ in times]


def test_the_service_sends_nothing_of_its_own_before_the_claim_nor_after_its_loss():
    messages = drive_messages(reference_configuration(), 3.0)
    lost_at = messages[0].timestamp + 1.5
    rival = name_of(OURS.model_copy(update={"identity_number": 1})).to_bytes(8, "little")
    contest = can.Message(timestamp=lost_at, arbitration_id=CLAIM, data=rival)
    claim, notifier = AddressClaim(OURS, ADDRESS), Notes()
    bench = Bench(sorted([*messages, contest], key=lambda m: m.timestamp), claim=claim, notifier=notifier)
    bench.run(0.5)
    assert of_ours(bench) == []
    assert notifier.said.endswith(", address 0x9a not claimed yet")
    wait_until_held(claim)
    bench.run(2.4)
    assert lost_at - 1.1 < min(of_ours(bench)) < lost_at - 0.8
    assert max(of_ours(bench)) == pytest.approx(lost_at, abs=0.12)
    assert [m.arbitration_id for _, m in bench.wire.sent][-1] == CANNOT_CLAIM
    assert notifier.said.endswith(", address 0x9a belongs to a node with a smaller NAME")
    claim.close()


def test_when_the_bus_comes_back_the_address_is_claimed_again():
    claim = AddressClaim(OURS, ADDRESS)
    bench = Bench(drive_messages(reference_configuration(), 4.0), claim=claim)
    bench.run(0.2)
    wait_until_held(claim)
    bench.run(0.5)
    assert of_ours(bench)
    bench.wire.fail_receive.append(can.CanOperationError("network is down"))
    lost = bench.run(2.0)
    assert of_ours(bench, lost + 0.1) == []
    wait_until_held(claim)
    again = bench.run(0.5)
    assert bench.wire.sent[-1][0] > again
    assert of_ours(bench, again)
    assert CLAIM in {m.arbitration_id for t, m in bench.wire.sent if t >= again}
    claim.close()


def test_frames_carry_the_configured_address():
    config = reference_configuration(["j1939.address=0xB0"])
    assert {message.frame_id & 0xFF for message in output_database(config).messages} == {0xB0}
    assert {message.frame_id & 0xFF for message in output_database(reference_configuration()).messages} == {ADDRESS}


def test_without_the_extra_the_configuration_is_refused(monkeypatch):
    monkeypatch.setattr("soilbus.daemon.address_claim.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"j1939: needs the extra soilbus\[j1939\]"):
        AddressClaim(OURS, ADDRESS)
