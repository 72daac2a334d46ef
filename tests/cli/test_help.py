"""The help of each command ends with a line that the command line takes; a shell completes commands and options."""

import shlex
import subprocess
from pathlib import Path

import pytest

from soilbus.cli.arguments import command_line, subcommands
from soilbus.cli.main import main

COMMANDS = subcommands(command_line())


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_with_an_example_that_is_right(name, capsys):
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    head, line = capsys.readouterr().out.rstrip("\n").splitlines()[-2:]
    assert head == "example:"
    program, *words = shlex.split(line.partition(" >")[0])
    assert program == "soilbus"
    args = command_line().parse_args(words)
    assert args.command == name


def completed(script: Path, *words: str) -> set[str]:
    """What bash offers for the last of these words."""
    lines = [
        f"source {shlex.quote(str(script))}",
        f"COMP_WORDS=({' '.join(map(shlex.quote, words))}); COMP_CWORD={len(words) - 1}",
        '_shtab_soilbus; printf "%s\\n" "${COMPREPLY[@]}"',
    ]
    done = subprocess.run(["bash", "-c", "\n".join(lines)], capture_output=True, text=True, timeout=20.0, check=True)
    return set(done.stdout.split())


def test_bash_completes_commands_options_and_files(tmp_path, monkeypatch, capsys):
    pytest.importorskip("shtab")
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "soilbus"
    script.write_text(capsys.readouterr().out)
    assert completed(script, "soilbus", "ch") == {"check"}
    assert {"--dbc", "--log", "--out"} <= completed(script, "soilbus", "init", "--")
    assert completed(script, "soilbus", "completion", "z") == {"zsh"}
    (tmp_path / "vehicle.dbc").touch()
    monkeypatch.chdir(tmp_path)
    assert completed(script, "soilbus", "init", "--dbc", "veh") == {"vehicle.dbc"}


def test_zsh_gets_a_completion_of_its_own(capsys):
    pytest.importorskip("shtab")
    assert main(["completion", "zsh"]) == 0
    assert capsys.readouterr().out.startswith("#compdef soilbus")
