"""What is installed: the wheel's contents, the versions, the lock file, the Makefile's set-up."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from bipedtrack import __version__, paths, versions

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCK = (ROOT / "requirements.lock").read_text()


def run(*arguments: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(a) for a in arguments], cwd=cwd, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def unpacked_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the contents of a wheel built offline from this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir")
    built = run(sys.executable, "-m", "pip", "wheel", *options, folder, ROOT)
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = folder.glob("bipedtrack-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


@pytest.mark.parametrize("name", ["models", "curricula"])
def test_wheel_carries_every_data_file(unpacked_wheel: Path, name: str) -> None:
    checkout = {f.relative_to(ROOT) for f in (ROOT / name).rglob("*") if f.is_file()}
    package = unpacked_wheel / "bipedtrack"
    wheel = {f.relative_to(package) for f in (package / name).rglob("*") if f.is_file()}
    assert checkout
    assert checkout == wheel


def test_wheel_holds_the_package_and_nothing_else(unpacked_wheel: Path) -> None:
    assert {f.name for f in unpacked_wheel.iterdir()} == {"bipedtrack", f"bipedtrack-{__version__}.dist-info"}
    entry_points = (unpacked_wheel / f"bipedtrack-{__version__}.dist-info/entry_points.txt").read_text()
    assert "bipedtrack = bipedtrack.__main__:main" in entry_points


def test_installed_package_finds_its_data_inside_itself(unpacked_wheel: Path) -> None:
    found = run(
        sys.executable,
        "-c",
        "from bipedtrack.paths import data_dir; print(data_dir('models'))",
        cwd=unpacked_wheel,
    )
    assert Path(found.stdout.strip()) == unpacked_wheel / "bipedtrack" / "models", found.stderr


def test_checkout_finds_its_data_beside_the_package() -> None:
    assert paths.data_dir("models") == ROOT / "models"


def test_missing_data_say_where_they_were_sought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "__file__", str(tmp_path / "bipedtrack" / "paths.py"))
    with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path))):
        paths.data_dir("curricula")


def test_version_command_prints_package_and_stack() -> None:
    shown = run(sys.executable, "-m", "bipedtrack", "--version")
    assert shown.returncode == 0
    package, *stack = shown.stdout.splitlines()
    assert package == f"bipedtrack {__version__}"
    assert [line.split()[0] for line in stack] == list(versions.TESTED)


def test_command_without_arguments_lists_the_commands() -> None:
    shown = run(sys.executable, "-m", "bipedtrack")
    assert shown.returncode == 0
    for command in ("train", "export", "doctor"):
        assert f"python -m bipedtrack.{command}" in shown.stdout


def test_version_command_imports_nothing_heavy() -> None:
    loaded = run(sys.executable, "-c", "import sys, bipedtrack.__main__; print(*sys.modules)").stdout.split()
    assert "bipedtrack.versions" in loaded
    assert not {"jax", "mujoco", "brax", "flax", "numpy"} & set(loaded)


def install(monkeypatch: pytest.MonkeyPatch, **found: str | None) -> None:
    """Pretends that the tested versions are installed, apart from those named; None is not installed."""
    installed = {name: tested.version for name, tested in versions.TESTED.items()} | found

    def version(name: str) -> str:
        if (number := installed[name]) is None:
            raise metadata.PackageNotFoundError(name)
        return number

    monkeypatch.setattr(versions.metadata, "version", version)


@pytest.mark.parametrize(
    ("found", "ok"),
    [("0.9.2", True), ("0.9.10", True), ("0.9.2+cuda12", True), ("0.9.1", False), ("0.10.0.dev1", False)],
)
def test_range_of_jax(monkeypatch: pytest.MonkeyPatch, found: str, ok: bool) -> None:
    install(monkeypatch, jax=found)
    rows = {row.name: row for row in versions.check()}
    assert rows.pop("jax") == ("jax", "0.9.2", found, ok)
    assert all(row.ok for row in rows.values())


def test_tested_versions_satisfy_require(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    versions.require()


def test_version_error_names_cause_and_remedy_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, jax="0.10.2")
    with pytest.raises(versions.VersionError) as caught:
        versions.require()
    message = str(caught.value)
    for part in ("jax 0.10.2", ">=0.9.2,<0.10", "device_put_replicated", "hung", "make setup", "jax==0.9.2"):
        assert part in message
    assert "\n" not in message


def test_missing_package_is_a_version_error(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, brax=None)
    with pytest.raises(versions.VersionError, match="brax is not installed"):
        versions.require()
    assert "missing" in versions.table(versions.check())


def test_requirements_admit_exactly_the_tested_ranges() -> None:
    required = {r.name: r.specifier for r in map(Requirement, PROJECT["dependencies"])}
    for name, tested in versions.TESTED.items():
        if name != "jaxlib":  # comes with jax, in the same version
            assert tested.version in required[name], name
            assert tested.below not in required[name], name


def test_lock_pins_every_requirement_and_the_tested_versions() -> None:
    pins = dict(re.findall(r"^([a-z0-9-]+)==([^ ]+)", LOCK, re.MULTILINE))
    for name, tested in versions.TESTED.items():
        assert pins[name] == tested.version
    for requirement in map(Requirement, PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]):
        assert pins[requirement.name.lower()] in requirement.specifier


def test_lock_holds_only_pins_and_hashes() -> None:
    line = r"[a-z0-9-]+==[\w.]+( ; [\w.' !=<>]+)? \\|    --hash=sha256:[0-9a-f]{64}( \\)?|#.*"
    odd = [text for text in LOCK.splitlines() if not re.fullmatch(line, text)]
    assert not odd
    assert "/" not in LOCK


@pytest.fixture
def installed_checkout(tmp_path: Path) -> Path:
    """A folder in which `make setup` has nothing left to do."""
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "requirements.lock").touch()
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / ".installed").touch()
    return tmp_path


def test_second_setup_installs_nothing(installed_checkout: Path) -> None:
    again = run("make", "setup", "PYTHON=false", cwd=installed_checkout)
    assert again.returncode == 0, again.stderr
    assert "Nothing to be done" in again.stdout


def test_setup_refuses_another_python_in_one_line(installed_checkout: Path) -> None:
    (installed_checkout / ".venv" / ".installed").unlink()
    refused = run("make", "--silent", "setup", "PYTHON=false", cwd=installed_checkout)
    assert refused.returncode != 0
    ours = [line for line in refused.stderr.splitlines() if not line.startswith("make")]
    assert len(ours) == 1
    assert "Python 3.11 or 3.12" in ours[0]
