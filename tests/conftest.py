"""What many tests share: the robot, its compiled model, the default curriculum. JAX runs on the CPU."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before anything imports jax

import hypothesis
import mujoco
import pytest

from bipedtrack import robot as robots
from bipedtrack.curriculum import Curriculum
from bipedtrack.curriculum import load as load_curriculum

# compiling and a busy machine make single examples slow; that is no failure
hypothesis.settings.register_profile("bipedtrack", deadline=None)
hypothesis.settings.load_profile("bipedtrack")


@pytest.fixture(scope="session")
def robot() -> robots.Robot:
    """The constants of the robot of Table I, float64."""
    return robots.load()


@pytest.fixture(scope="session")
def mj_model() -> mujoco.MjModel:
    """Its compiled model, without boxes. Tests that change a model build their own."""
    return robots.build_model("ranger_max")


@pytest.fixture(scope="session")
def curriculum() -> Curriculum:
    """The default curriculum."""
    return load_curriculum("quick")
