"""What the README promises, run as it stands there."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

TOP = pathlib.Path(__file__).resolve().parent.parent
README = (TOP / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    """The first fenced block of a language."""
    found = re.search(rf"```{language}\n(.*?)```", README, re.DOTALL)
    assert found, f"no {language} block in the README"
    return found[1]


def test_the_script_of_the_readme_walks_to_its_last_foothold(tmp_path: pathlib.Path) -> None:
    (tmp_path / "walk.csv").write_text(block("csv"))
    (tmp_path / "models").symlink_to(TOP / "models")
    program = "import sys; sys.modules.update(jax=None, brax=None, flax=None)\n" + block("python")
    run = [sys.executable, "-c", program]
    place = {**os.environ, "PYTHONPATH": str(TOP)}
    done = subprocess.run(run, cwd=tmp_path, env=place, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    x, y, z = map(float, re.findall(r"-?\d+\.\d*", done.stdout)[:3])
    # the last footholds are at x = 0.5 m, the trunk belongs 0.75 m above the middle between them
    assert x == pytest.approx(0.5, abs=0.1)
    assert y == pytest.approx(0.0, abs=0.1)
    assert z == pytest.approx(0.75, abs=0.1)


def test_the_readme_fits_its_size_and_names_files_that_exist() -> None:
    assert len(README.splitlines()) <= 250
    named = re.findall(r"`((?:curricula|models|bipedtrack)/[\w/.-]+\.\w+)`", README)
    shown = re.findall(r"\]\((\S+?)\)", README)
    assert len(named) > 10 and len(shown) > 5
    for path in named + shown:
        assert (TOP / path).exists(), path


def test_functions_that_the_readme_names_exist() -> None:
    import importlib

    table = README[README.index("| paper | what | where |") : README.index("### Where we read")]
    named = re.findall(r"`(\w+)\.([\w.]+)`", table)
    assert len(named) > 20
    for module, name in named:
        if module != "curricula":
            found = importlib.import_module(f"bipedtrack.{module}")
            for part in name.split("."):
                found = getattr(found, part)
