"""Seeds as a user types them."""

from __future__ import annotations

import pytest

from soilbus.cli.main import main


@pytest.mark.parametrize("seed", ["-1", "1.5", "x", ""])
def test_a_wrong_seed_is_named_in_one_line_and_nothing_is_written(seed, tmp_path, capsys):
    out = tmp_path / "drive.log"
    with pytest.raises(SystemExit) as stop:
        main(["simulate", "--log", str(out), f"--seed={seed}"])
    assert stop.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == f"soilbus simulate: error: argument --seed: {seed} is not a whole number from 0 up"
    assert not out.exists()
