"""The planner: curves against their textbook formulas, rates against automatic differentiation."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation, Slerp

from bipedtrack import planner
from bipedtrack.nodes import Nodes
from bipedtrack.planner import TaskStep

SEEDS = st.integers(0, 2**32 - 1).map(np.random.default_rng)
KINDS = pytest.mark.parametrize("trigonometric", [0.0, 1.0], ids=["bezier", "trigonometric"])


def random_step(random: np.random.Generator, trigonometric: float, order: int = 4, dtype: Any = np.float64) -> TaskStep:
    """A step with a random foot in the air; the other one and its control points stay where they are."""

    def random_nodes() -> Nodes:
        return Nodes(
            trunk_position=random.uniform(-1, 1, 3),
            trunk_orientation=Rotation.from_euler("xyz", random.uniform(-1, 1, 3)).as_quat(scalar_first=True),
            ankle_positions=random.uniform(-1, 1, (2, 3)),
            ankle_yaws=random.uniform(-3, 3, 2),
        )

    start, end = random_nodes(), random_nodes()
    swing = np.eye(2)[random.integers(2)]
    stance = int(np.argmin(swing))
    end.ankle_positions[stance] = start.ankle_positions[stance]
    end.ankle_yaws[stance] = start.ankle_yaws[stance]
    points = random.uniform(-1, 1, (2, order + 1, 3))
    points[:, 0], points[:, -1] = start.ankle_positions, end.ankle_positions
    points[stance] = start.ankle_positions[stance]
    step = TaskStep(
        start=start,
        end=end,
        period=np.asarray(random.uniform(0.4, 0.7)),
        swing=swing,
        ankle_points=points,
        lift=swing * random.uniform(0.02, 0.2),
        trigonometric=np.asarray(trigonometric),
        ease=np.asarray(random.choice([0.0, random.uniform(0.01, 0.49)])),
        pivot=random.uniform(-1, 1, 2),
        pendulum=np.asarray(random.choice([0.0, random.uniform(2, 5)])),
    )
    return jax.tree.map(lambda x: np.asarray(x, dtype), step)


def bernstein(points: np.ndarray, s: float) -> tuple[np.ndarray, np.ndarray]:
    """The sum of C(n, i) s^i (1 - s)^(n - i) P_i and its derivative by s."""
    n = points.shape[-2] - 1
    value, slope = np.zeros(points.shape[-1]), np.zeros(points.shape[-1])
    for i in range(n + 1):
        choose = math.comb(n, i)
        rising = i * s ** (i - 1) * (1 - s) ** (n - i) if i > 0 else 0.0
        falling = (n - i) * s**i * (1 - s) ** (n - i - 1) if i < n else 0.0
        value = value + choose * s**i * (1 - s) ** (n - i) * points[i]
        slope = slope + choose * (rising - falling) * points[i]
    return value, slope


@pytest.mark.parametrize("order", range(1, 7))
@given(random=SEEDS, s=st.floats(0, 1))
def test_bezier_curve_of_any_order_is_the_bernstein_sum(order: int, random: np.random.Generator, s: float) -> None:
    points = random.normal(size=(2, order + 1, 3))
    value, slope = planner.bezier(points, np.asarray(s))
    for foot in range(2):
        expected = bernstein(points[foot], s)
        assert value[foot] == pytest.approx(expected[0], abs=1e-12)
        assert slope[foot] == pytest.approx(expected[1], abs=1e-11)


@pytest.mark.parametrize("ease", [0.0, 0.1, 0.25, 0.49])
def test_eased_speed_rises_from_rest_stays_and_falls_to_rest(ease: float) -> None:
    share = np.linspace(0, 1, 20_001)
    way, speed = planner.eased(share, np.full_like(share, ease))
    assert (way[0], way[-1]) == (0, 1) and way[10_000] == pytest.approx(0.5, abs=1e-12)
    # the trapezoid by hand: its area is 1, so its top is 1 / (1 - ease)
    corners = ([0, ease, 1 - ease, 1], [0, 1 / (1 - ease), 1 / (1 - ease), 0]) if ease else ([0, 1], [1, 1])
    assert speed == pytest.approx(np.interp(share, *corners), abs=1e-9)
    summed = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(share))])
    assert way == pytest.approx(summed, abs=1e-7)


def test_an_eased_swing_leaves_the_ground_and_comes_down_at_rest() -> None:
    step = random_step(np.random.default_rng(0), trigonometric=0.0)
    for ease, moves in ((0.25, False), (0.0, True)):
        eased = step._replace(ease=np.asarray(ease))
        for time in (0.0, float(step.period) - 1e-9):
            speed = np.abs(planner.command(eased, np.asarray(time)).rates.ankle_velocities).max()
            assert (speed > 0.1) == moves and (moves or speed < 1e-6)


@pytest.mark.parametrize("order", [1, 4, 6])
def test_rates_are_the_derivatives_of_the_targets(order: int) -> None:
    random = np.random.default_rng(order)
    with jax.enable_x64(True):
        steps = [random_step(random, trigonometric=i % 2, order=order) for i in range(100)]
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *steps)
        times = jnp.asarray(random.uniform(0.001, 0.999, 100)) * stacked.period

        @jax.jit
        @jax.vmap
        def derivative(step: TaskStep, time: Any) -> tuple:
            def target(t: Any) -> Nodes:
                return planner.command(step, t).target

            return *jax.jvp(target, (time,), (jnp.ones(()),)), planner.command(step, time).rates

        target, slope, rates = jax.tree.map(np.asarray, derivative(stacked, times))
    assert rates.ankle_velocities.dtype == np.float64
    assert rates.trunk_velocity == pytest.approx(slope.trunk_position, abs=1e-10)
    assert rates.ankle_velocities == pytest.approx(slope.ankle_positions, abs=1e-10)
    assert rates.ankle_yaw_rates == pytest.approx(slope.ankle_yaws, abs=1e-10)
    # dq/dt = (0, w) q / 2 with w in the world, so (0, w) = 2 dq/dt q^-1
    w, x, y, z = target.trunk_orientation.T
    dw, dx, dy, dz = slope.trunk_orientation.T
    angular = 2 * np.stack(
        [
            dx * w - dw * x - dy * z + dz * y,
            dy * w - dw * y - dz * x + dx * z,
            dz * w - dw * z - dx * y + dy * x,
        ],
        axis=-1,
    )
    assert rates.trunk_angular_velocity == pytest.approx(angular, abs=1e-9)
    assert np.abs(angular).max() > 1  # the test would not notice a missing turn otherwise


@KINDS
@given(random=SEEDS)
def test_target_leads_from_the_start_to_the_end(trigonometric: float, random: np.random.Generator) -> None:
    step = random_step(random, trigonometric)
    for time, place in ((np.asarray(0.0), step.start), (step.period, step.end)):
        command = planner.command(step, time)
        target = command.target
        assert target.trunk_position == pytest.approx(place.trunk_position, abs=1e-12)
        assert target.ankle_positions == pytest.approx(place.ankle_positions, abs=1e-12)
        turns = (target.ankle_yaws - place.ankle_yaws) / (2 * math.pi)
        assert turns == pytest.approx(np.round(turns), abs=1e-12)
        sign = np.sign(target.trunk_orientation @ place.trunk_orientation)
        assert sign * target.trunk_orientation == pytest.approx(place.trunk_orientation, abs=1e-12)
        assert command.end is step.end


@given(random=SEEDS, s=st.floats(0, 1))
def test_trunk_moves_uniformly_and_turns_about_one_axis(random: np.random.Generator, s: float) -> None:
    step = random_step(random, 0.0)._replace(pendulum=np.asarray(0.0))
    target = planner.command(step, s * step.period).target
    start, end = step.start, step.end
    assert target.trunk_position == pytest.approx((1 - s) * start.trunk_position + s * end.trunk_position)
    ends = np.stack([start.trunk_orientation, end.trunk_orientation])
    expected = Slerp([0, 1], Rotation.from_quat(ends, scalar_first=True))(s)
    found = Rotation.from_quat(target.trunk_orientation, scalar_first=True)
    assert (found.inv() * expected).magnitude() == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_trunk_sways_across_the_stance_foot_as_a_linear_inverted_pendulum(seed: int) -> None:
    """Integrated from its first place and velocity, y'' = w^2 (y - pivot) arrives at the end in the period; x is uniform."""
    step = random_step(np.random.default_rng(seed), 0.0)._replace(pendulum=np.asarray(4.0))
    times = np.linspace(0, float(step.period), 9)[:-1]
    found = [planner.command(step, time) for time in times]
    heading = step.start.ankle_yaws[step.swing.argmin()]
    along, across = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
    places = np.array([command.target.trunk_position for command in found])
    rates = np.array([command.rates.trunk_velocity for command in found])
    start, end = step.start.trunk_position, step.end.trunk_position

    def fall(_: float, state: np.ndarray) -> np.ndarray:
        return np.array([state[1], 16 * (state[0] - across @ step.pivot)])

    span = 0, float(step.period)
    first = [across @ start[:2], across @ rates[0, :2]]
    expected = solve_ivp(fall, span, first, t_eval=[*times, span[1]], rtol=1e-10, atol=1e-12).y.T
    assert expected[-1, 0] == pytest.approx(across @ end[:2], abs=1e-7)
    assert places[:, :2] @ across == pytest.approx(expected[:-1, 0], abs=1e-7)
    assert rates[:, :2] @ across == pytest.approx(expected[:-1, 1], abs=1e-6)
    share, way = times / span[1], end - start
    assert places[:, :2] @ along == pytest.approx(along @ start[:2] + share * (along @ way[:2]))
    assert rates[:, :2] @ along == pytest.approx(along @ way[:2] / span[1])
    assert places[:, 2] == pytest.approx(start[2] + share * way[2])


def test_sway_worked_by_hand() -> None:
    """Stepping in place, feet 0.2 m apart: the trunk turns back 0.1 - 0.1 / cosh(w T / 2) from the middle."""
    step = random_step(np.random.default_rng(0), 0.0)
    start = step.start._replace(trunk_position=np.array([0.0, 0.0, 0.75]), ankle_yaws=np.zeros(2))
    step = step._replace(
        start=start, end=start, period=np.asarray(0.5), pivot=np.array([0.0, 0.1]), pendulum=np.asarray(4.0)
    )
    middle = planner.command(step, np.asarray(0.25))
    assert middle.target.trunk_position == pytest.approx([0, 0.1 - 0.1 / math.cosh(1), 0.75])
    assert middle.rates.trunk_velocity == pytest.approx(0, abs=1e-12)
    assert planner.command(step, np.asarray(0.0)).rates.trunk_velocity[1] == pytest.approx(0.4 * math.tanh(1))


@given(random=SEEDS)
def test_ankle_yaw_takes_the_shorter_way_and_rests_at_both_ends(random: np.random.Generator) -> None:
    step = random_step(random, 0.0)
    yaws = np.array([planner.command(step, s * step.period).target.ankle_yaws for s in np.linspace(0, 1, 11)])
    way = np.angle(np.exp(1j * (step.end.ankle_yaws - step.start.ankle_yaws)))
    assert yaws[-1] - yaws[0] == pytest.approx(way, abs=1e-12)
    assert yaws[5] - yaws[0] == pytest.approx(way / 2, abs=1e-12)
    assert (np.diff(yaws, axis=0) * np.sign(way) >= -1e-12).all()
    for time in (0.0, 1 - 1e-9):
        rates = planner.command(step, time * step.period).rates.ankle_yaw_rates
        assert rates == pytest.approx(0, abs=1e-6)


def test_trigonometric_curve_worked_by_hand() -> None:
    start, end, lift = np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, 2.0, 0.5]]), np.array([0.1, 0.2])
    middle, rate = planner.trigonometric(start, end, lift, np.asarray(0.5))
    assert middle == pytest.approx(np.array([[0.5, 0, 0.1], [0, 1.0, 0.25 + 0.2]]))
    assert rate == pytest.approx(2 * end)  # twice the mean speed along the way, no vertical speed of the lift
    quarter, rate = planner.trigonometric(start, end, lift, np.asarray(0.25))
    along = 0.25 - 1 / (2 * math.pi)
    assert quarter == pytest.approx(np.array([[along, 0, 0.05], [0, 2 * along, along / 2 + 0.1]]))
    assert rate == pytest.approx(np.array([[1, 0, 0.1 * math.pi], [0, 2, 0.5 + 0.2 * math.pi]]))
    for s in (0.0, 1.0):
        assert planner.trigonometric(start, end, lift, np.asarray(s))[1] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("order", range(2, 7))
def test_symmetric_curve_rises_by_exactly_its_lift(order: int) -> None:
    start = np.array([[0.0, 0.1, 0.04], [0.0, -0.1, 0.04]])
    end = start + [0.3, 0, 0]
    lift = np.array([0.08, 0.0])
    along = np.arange(1, order) / order
    points = planner.swing_points(start, end, lift, along, np.ones(order - 1))
    assert points.shape == (2, order + 1, 3)
    curve = np.array([planner.bezier(points, np.asarray(s))[0] for s in np.linspace(0, 1, 201)])
    assert curve[:, 0, 2].max() == pytest.approx(0.04 + 0.08)
    assert curve[100, 0] == pytest.approx([0.15, 0.1, 0.12])
    # the foot that is not lifted keeps its height, and evenly spaced points make a uniform motion
    assert curve[:, 1, 2] == pytest.approx(0.04)
    assert curve[:, :, 0] == pytest.approx(np.linspace(0, 0.3, 201)[:, None] * [1, 1])


def test_lift_counts_from_the_higher_end() -> None:
    start, end = np.array([[0.0, 0, 0.04]] * 2), np.array([[0.6, 0, 0.34], [0.6, 0, -0.2]])
    points = planner.swing_points(start, end, np.full(2, 0.1), np.array([0.05, 0.5, 0.95]), np.array([1.0, 0.5, 2]))
    rise = 0.1 * 8 / 7  # a quartic takes 7/8 of its inner points' height at the middle
    assert points[0, 1:4, 2] == pytest.approx(0.34 + rise * np.array([1, 0.5, 2]))
    assert points[1, 1:4, 2] == pytest.approx(0.04 + rise * np.array([1, 0.5, 2]))
    assert points[:, :, 0] == pytest.approx(np.array([[0, 0.03, 0.3, 0.57, 0.6]] * 2))


@pytest.mark.parametrize(
    ("lift", "edge", "wanted"),
    [
        (0.1, (0.5, 0.2), 0.2),
        (0.3, (0.5, 0.2), 0.3),
        (0.1, (0.25, 0.2), 0.8 / 3),
        (0.1, (0.75, -1.0), 0.1),
        (0.1, (2.0, 9.0), 0.1),
    ],
)
def test_a_curve_is_lifted_over_an_edge_worked_by_hand(lift: float, edge: tuple, wanted: float) -> None:
    """A parabola from (0, 0) to (1, 0) has the height 4 lift x (1 - x)."""
    start, end = np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, 0, 0]])
    curve = {"along": np.array([0.5]), "height": np.ones(1)}
    edges = np.array([[edge], [(5.0, 9.0)]])
    found = planner.lift_over(start, end, np.full(2, lift), **curve, edges=edges, reach=0.01)
    assert found == pytest.approx(np.array([wanted, lift]))


def test_without_lift_a_foot_slides_along_the_straight_line() -> None:
    start, end = np.array([[0.0, 0, 0.04]] * 2), np.array([[0.6, 0.3, 0.34], [0.6, -0.3, -0.26]])
    points = planner.swing_points(start, end, np.zeros(2), np.array([0.25, 0.5, 0.75]), np.array([0.8, 1, 1.2]))
    expected = start[:, None] + np.linspace(0, 1, 5)[:, None] * (end - start)[:, None]
    assert points == pytest.approx(expected)


@KINDS
@given(random=SEEDS, s=st.floats(0, 0.999))
def test_timer_is_the_time_until_the_swing_foot_lands(trigonometric: float, random: np.random.Generator, s: float) -> None:
    step = random_step(random, trigonometric)
    timer = planner.command(step, s * step.period).timer
    assert timer[step.swing > 0] == pytest.approx([(1 - s) * step.period])
    assert (timer[step.swing == 0] == 0).all()


@KINDS
@given(random=SEEDS, later=st.floats(0, 10))
def test_after_its_period_a_step_stands_still_at_its_end(
    trigonometric: float, random: np.random.Generator, later: float
) -> None:
    step = random_step(random, trigonometric)
    command = planner.command(step, step.period + later)
    assert all((part == 0).all() for part in command.rates)
    assert (command.timer == 0).all()
    at_end = planner.command(step, step.period).target
    for part, expected in zip(command.target, at_end, strict=True):
        assert (part == expected).all()


@KINDS
def test_stance_foot_does_not_move(trigonometric: float) -> None:
    step = random_step(np.random.default_rng(5), trigonometric)
    stance = int(np.argmin(step.swing))
    for time in np.linspace(0, 1, 13):
        command = planner.command(step, np.asarray(time))
        target, rates = command.target, command.rates
        assert target.ankle_positions[stance] == pytest.approx(step.start.ankle_positions[stance], abs=1e-12)
        assert rates.ankle_velocities[stance] == pytest.approx(0, abs=1e-12)
        assert rates.ankle_yaw_rates[stance] == 0


def test_jax_gives_numpys_commands() -> None:
    random = np.random.default_rng(6)
    steps = [random_step(random, trigonometric=i % 2, dtype=np.float32) for i in range(200)]
    times = random.uniform(0, 0.8, 200).astype(np.float32)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *steps)
    in_jax = jax.jit(jax.vmap(planner.command))(stacked, times)
    in_numpy = [planner.command(step, time) for step, time in zip(steps, times, strict=True)]
    in_numpy = jax.tree.map(lambda *x: np.stack(x), *in_numpy)
    for found, expected in zip(jax.tree.leaves(in_jax), jax.tree.leaves(in_numpy), strict=True):
        assert found.dtype == expected.dtype == np.float32
        scale = np.maximum(1, np.abs(expected).max())
        assert np.asarray(found) / scale == pytest.approx(expected / scale, abs=1e-6)
