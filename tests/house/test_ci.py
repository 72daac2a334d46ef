"""The whole check says at once what it cannot do without."""

import shutil
import subprocess
from pathlib import Path

CI = Path(__file__).resolve().parents[2] / ".ci"


def test_missing_recordings_are_one_line_before_any_work(tmp_path: Path) -> None:
    shutil.copytree(CI, tmp_path / "clone/.ci")
    done = subprocess.run([tmp_path / "clone/.ci/run"], capture_output=True, text=True, timeout=30.0)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert f"no {tmp_path}/shared/field/loam.log.gz" in line
    assert list((tmp_path / "clone").iterdir()) == [tmp_path / "clone/.ci"]
