"""The folder of compiled programs: whose it is, what it depends on, and that nothing fails without it."""

import pathlib
import subprocess
import sys

import pytest

from bipedtrack import compilation, versions


def use_cache(home: pathlib.Path, **environment: str) -> str:
    """What a process of its own prints of the folder and of JAX's setting."""
    code = (
        "import jax; from bipedtrack.compilation import use_cache; print(use_cache(), jax.config.jax_compilation_cache_dir)"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        env={"HOME": str(home), "PATH": "/usr/bin:/bin", **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return found.stdout.strip()


def test_programs_are_kept_in_the_users_cache_for_nobody_else(tmp_path: pathlib.Path) -> None:
    folder, setting = use_cache(tmp_path).split()
    assert folder == setting and pathlib.Path(folder).parent == tmp_path / ".cache" / "bipedtrack"
    assert pathlib.Path(folder).stat().st_mode & 0o777 == 0o700
    pathlib.Path(folder).chmod(0o755)
    assert use_cache(tmp_path).split()[0] == folder
    assert pathlib.Path(folder).stat().st_mode & 0o777 == 0o700


def test_jaxs_own_setting_decides_where_it_is_set(tmp_path: pathlib.Path) -> None:
    elsewhere = str(tmp_path / "elsewhere")
    assert use_cache(tmp_path, JAX_COMPILATION_CACHE_DIR=elsewhere) == f"{elsewhere} {elsewhere}"
    assert not (tmp_path / ".cache").exists()


def test_without_a_place_everything_still_works(tmp_path: pathlib.Path) -> None:
    (tmp_path / ".cache").write_text("a file where a folder should be")
    assert use_cache(tmp_path) == "None None"


def test_a_user_without_a_home_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> pathlib.Path:
        raise RuntimeError("Could not determine home directory.")  # as pathlib does it

    for name in ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pathlib.Path, "home", nowhere)
    assert compilation.use_cache() is None


def test_another_version_has_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    here = compilation._machine()
    rows = [row._replace(found="9.9.9") if row.name == "jaxlib" else row for row in versions.check()]
    monkeypatch.setattr(versions, "check", lambda: rows)
    assert compilation._machine() != here
