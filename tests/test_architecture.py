"""Imports inside the package point one way, and what runs a policy needs neither JAX nor MuJoCo."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import bipedtrack

FOLDER = Path(bipedtrack.__file__).parent
MODULES = {path.stem: path for path in FOLDER.glob("*.py")}

# A module may import those before it: on a line above, or further left on its own.
LADDER = """
    messages versions paths addresses record markup drawing
    compilation distributed
    config checkpoint run_directory
    rotations robot
    nodes kinematics statics falls trace packets
    planner terrain sampling feasibility rows
    footsteps footholds tasks scripts steering plans disturbances
    control observation symmetry rewards feedback_error balance swings metrics verdicts charts
    policy follower onnx_export env autoreset
    curriculum adapted_brax networks rollout progress recording suite pictures
    training evaluation sheets comparisons report
    doctor train curves export evaluate simulate video teleop drive realtime scene server page play __main__
""".split()

# Between a command and the joint targets: on a robot there is numpy and nothing else.
DEPLOYMENT = (
    "rotations nodes kinematics statics planner terrain feasibility rows footsteps control observation symmetry policy"
    " packets follower robot config checkpoint"
).split()
ABSENT = ("jax", "flax", "brax", "optax", "mujoco")


def imported(source: str) -> set[str]:
    """The package's own modules that a source imports, at its top or inside a function."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            origin = f"bipedtrack.{node.module or ''}".rstrip(".") if node.level else node.module
            names = [f"{origin}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            package, _, rest = name.partition(".")
            module = rest.partition(".")[0]
            if package == "bipedtrack" and module in MODULES:
                found.add(module)
    return found


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import bipedtrack.env\nimport numpy", {"env"}),
        ("from bipedtrack import env, __version__, robot as robots", {"env", "robot"}),
        ("def f():\n    from bipedtrack.nodes import Nodes", {"nodes"}),
        ("from . import env\nfrom .nodes import Nodes", {"env", "nodes"}),
        ("import jax\nfrom brax import envs", set()),
    ],
)
def test_every_form_of_import_is_seen(source: str, expected: set[str]) -> None:
    assert imported(source) == expected


def test_every_module_has_its_place_on_the_ladder() -> None:
    assert set(MODULES) - {"__init__"} == set(LADDER), "a new module gets the lowest place that its imports allow"
    assert len(LADDER) == len(set(LADDER))


@pytest.mark.parametrize("module", LADDER)
def test_imports_point_one_way(module: str) -> None:
    allowed = set(LADDER[: LADDER.index(module)])
    assert imported(MODULES[module].read_text(encoding="utf-8")) <= allowed


def test_the_package_itself_imports_nothing() -> None:
    tree = ast.parse(MODULES["__init__"].read_text(encoding="utf-8"))
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=FOLDER.parent, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("modules", [*DEPLOYMENT, " ".join(DEPLOYMENT)])
def test_deployment_half_imports_without_jax_and_mujoco(modules: str) -> None:
    block = f"import sys; sys.modules.update(dict.fromkeys({ABSENT}))"
    imports = "; ".join(f"import bipedtrack.{module}" for module in modules.split())
    done = run(f"{block}; {imports}; print(sorted(n for n in sys.modules if n.partition('.')[0] in {ABSENT}))")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(sorted(ABSENT))  # the five blocked names, and nothing below them


def test_a_module_that_needs_jax_does_not_import_without_it() -> None:
    done = run("import sys; sys.modules['jax'] = None; import bipedtrack.tasks")
    assert done.returncode == 1
    assert "jax" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("module", ["train", "evaluate"])
def test_a_command_names_a_missing_jax_in_one_line(module: str) -> None:
    """As where it is not installed: neither its modules nor its metadata are there."""
    done = run(
        "import sys; from importlib import metadata\n"
        "sys.modules.update(dict.fromkeys(('jax', 'brax', 'flax', 'optax')))\n"
        "found, sys.argv = metadata.version, ['bipedtrack', *sys.argv[1:]]\n"
        "def version(name):\n"
        "    if name.startswith('jax'): raise metadata.PackageNotFoundError(name)\n"
        "    return found(name)\n"
        "metadata.version = version\n"
        f"from bipedtrack import {module}\n"
        f"sys.argv += ['ik'] if '{module}' == 'evaluate' else []\n"
        f"{module}.main()"
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("bipedtrack: jax is not installed")
