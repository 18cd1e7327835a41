"""Streams of packets become commands that are smooth, bounded and true to what was sent."""

import math

import numpy as np
import pytest

from bipedtrack import footsteps, kinematics, nodes, planner, rotations, terrain
from bipedtrack.follower import HOLD, Follower
from bipedtrack.nodes import NodeRates, Nodes
from bipedtrack.packets import FASTEST, Packet, Refused, speed
from bipedtrack.planner import Command
from bipedtrack.robot import Robot

DT = 0.005
WALK = ",".join(footsteps.COLUMNS) + "\nleft,0.1\nright,0.2\nleft,0.3\nright,0.3\n"


@pytest.fixture
def follower(robot: Robot) -> Follower:
    return Follower(robot, footsteps.initial_nodes(robot))


def shifted(robot: Robot, dx: float = 0, dy: float = 0, dz: float = 0, foot: tuple = (0, 0, 0)) -> Nodes:
    """Standing with the trunk and the left foot moved by metres."""
    start = footsteps.initial_nodes(robot)
    ankles = start.ankle_positions + np.array([foot, (0, 0, 0)])
    return start._replace(trunk_position=start.trunk_position + [dx, dy, dz], ankle_positions=ankles)


def advance(follower: Follower, count: int) -> list[Command]:
    return [follower.advance() for _ in range(count)]


def ticks(seconds: float) -> int:
    return round(seconds / DT)


def assert_equal(found: Nodes, wanted: Nodes, tolerance: float = 1e-9) -> None:
    for error in nodes.difference(found, wanted):
        np.testing.assert_allclose(error, 0, atol=tolerance)


def assert_smooth(commands: list[Command]) -> None:
    """Targets are finite, move by their rates, and no faster than they may."""
    for now, then in zip(commands, commands[1:], strict=False):
        assert all(np.isfinite(part).all() for part in (*now.target, *now.rates, *now.end, now.timer))
        assert all(speed(rate).max() <= most * (1 + 1e-9) for rate, most in zip(now.rates, FASTEST, strict=True))
        np.testing.assert_allclose(then.target.trunk_position, now.target.trunk_position + DT * now.rates.trunk_velocity)
        np.testing.assert_allclose(then.target.ankle_positions, now.target.ankle_positions + DT * now.rates.ankle_velocities)
        np.testing.assert_allclose(then.target.ankle_yaws, now.target.ankle_yaws + DT * now.rates.ankle_yaw_rates)
        turn = rotations.from_rotation_vector(DT * now.rates.trunk_angular_velocity)
        turned = rotations.multiply(turn, now.target.trunk_orientation)
        np.testing.assert_allclose(then.target.trunk_orientation, turned, atol=1e-9)
        assert 0 <= now.timer.min() and now.timer.max() <= 2


# Following


def test_without_packets_it_stands(follower: Follower, robot: Robot) -> None:
    for command in advance(follower, 300):
        assert_equal(command.target, footsteps.initial_nodes(robot))
        assert_equal(command.end, footsteps.initial_nodes(robot))
        assert all(np.abs(rate).max() < 1e-6 for rate in command.rates) and not command.timer.any()
    assert follower.state == "standing"


def test_a_target_is_reached_when_the_next_packet_is_due_and_then_held(follower: Follower, robot: Robot) -> None:
    follower.accept(Packet(1, 0.0, shifted(robot)))
    advance(follower, 10)
    follower.accept(Packet(2, 0.05, shifted(robot, dz=-0.022)))
    commands = advance(follower, 30)
    np.testing.assert_allclose([c.target.trunk_position[2] for c in commands[:12]], 0.75 - 0.002 * np.arange(12))
    np.testing.assert_allclose([c.rates.trunk_velocity[2] for c in commands[:11]], -0.4)
    for command in commands[12:]:
        assert_equal(command.target, shifted(robot, dz=-0.022))
        np.testing.assert_allclose(np.concatenate([np.ravel(rate) for rate in command.rates]), 0, atol=1e-9)
    assert_smooth(commands)


def test_with_rates_a_steady_motion_is_followed_without_delay(follower: Follower, robot: Robot) -> None:
    velocity = NodeRates(np.array([0.3, 0, -0.1]), np.zeros(3), np.zeros((2, 3)), np.zeros(2))
    for tick in range(100):
        now = shifted(robot, dx=0.3 * tick * DT, dz=-0.1 * tick * DT)
        if tick % 4 == 0:
            follower.accept(Packet(tick, tick * DT, now, velocity))
        command = follower.advance()
        if tick > 30:
            assert_equal(command.target, now, 1e-6)
            np.testing.assert_allclose(command.rates.trunk_velocity, velocity.trunk_velocity, atol=1e-3)


def test_a_far_target_is_approached_at_the_greatest_speed(follower: Follower, robot: Robot) -> None:
    follower.accept(Packet(1, 0.0, shifted(robot, dz=-0.1)))
    commands = advance(follower, 30)
    assert_smooth(commands)
    assert commands[0].rates.trunk_velocity[2] == pytest.approx(-FASTEST.trunk_velocity)
    assert_equal(commands[-1].target, shifted(robot, dz=-0.1))


def test_end_and_timer_of_a_packet_are_the_commands(follower: Follower, robot: Robot) -> None:
    landed = shifted(robot, dx=0.05, foot=(0.1, 0, 0))
    follower.accept(Packet(1, 0.0, shifted(robot, foot=(0, 0, 0.01)), None, landed, np.array([0.4, 0.0])))
    for i, command in enumerate(advance(follower, 3)):
        assert_equal(command.end, landed)
        np.testing.assert_allclose(command.timer, [0.4 - i * DT, 0])


def test_without_them_a_lifted_foot_is_taken_to_land_beneath(follower: Follower, robot: Robot) -> None:
    up = shifted(robot, foot=(0.05, 0, 0.06))
    for i in range(10):
        follower.accept(Packet(i, i * 0.02, up))
        commands = advance(follower, 4)
    assert_equal(commands[-1].target, up)
    assert_equal(commands[-1].end, shifted(robot, foot=(0.05, 0, 0)))
    # in the air since the second of 40 control steps
    np.testing.assert_allclose(commands[-1].timer, [0.55 - 39 * DT, 0])
    follower.accept(Packet(10, 0.2, shifted(robot, foot=(0.05, 0, 0.03))))
    timers = [command.timer[0] for command in advance(follower, 5)]
    # 6 cm high, and half of it falls in 25 ms
    np.testing.assert_allclose(timers, 0.05 - DT * np.arange(5), atol=1e-9)


@pytest.mark.parametrize("every", [1, 2, 4, 10])
def test_a_streamed_walk_is_the_walk_a_packet_later(follower: Follower, robot: Robot, every: int) -> None:
    wanted = list(footsteps.commands(footsteps.parse(WALK, robot, "walk"), DT))
    found = []
    for tick, command in enumerate(wanted):
        if tick % every == 0:
            follower.accept(Packet(tick, tick * DT, command.target, command.rates, command.end, command.timer))
        found.append(follower.advance())
    assert_smooth(found)
    for now, then in zip(wanted[:-1], found[1:], strict=True):
        assert np.abs(then.target.ankle_positions - now.target.ankle_positions).max() < 0.01 * (1 + every)
        assert np.abs(then.target.trunk_position - now.target.trunk_position).max() < 0.005 * (1 + every)


# What is refused


def refusal(follower: Follower, packet: Packet) -> str:
    before = follower.target, follower.state
    with pytest.raises(Refused) as refused:
        follower.accept(packet)
    assert (follower.target, follower.state) == before
    return refused.value.reason


def test_duplicates_and_late_packets_are_refused_until_a_silence(follower: Follower, robot: Robot) -> None:
    follower.accept(Packet(5, 0.0, shifted(robot)))
    for sequence in (5, 4, 0):
        assert refusal(follower, Packet(sequence, 9.0, shifted(robot, dz=-0.1))) == "order"
    assert_equal(advance(follower, 20)[-1].target, shifted(robot))
    follower.accept(Packet(6, 0.02, shifted(robot, dz=-0.01)))
    advance(follower, ticks(HOLD) + 1)
    follower.accept(Packet(0, 0.0, shifted(robot)))


@pytest.mark.parametrize("time", [-1e12, 0.0, 1e12])
def test_a_senders_clock_may_say_anything(follower: Follower, robot: Robot, time: float) -> None:
    follower.accept(Packet(1, 0.0, shifted(robot)))
    follower.accept(Packet(2, time, shifted(robot, dz=-0.05)))
    assert_smooth(advance(follower, 50))


def test_targets_too_far_away_are_refused(follower: Follower, robot: Robot) -> None:
    here = shifted(robot)
    assert refusal(follower, Packet(1, 0.0, shifted(robot, dx=0.31))) == "jump"
    assert refusal(follower, Packet(1, 0.0, shifted(robot, foot=(0.41, 0, 0)))) == "jump"
    assert refusal(follower, Packet(1, 0.0, here._replace(ankle_yaws=np.array([0.0, 0.9])))) == "jump"
    turned = here._replace(trunk_orientation=np.array([math.cos(0.31), 0, 0, math.sin(0.31)]))
    assert refusal(follower, Packet(1, 0.0, turned)) == "jump"
    assert refusal(follower, Packet(1, 0.0, here, None, shifted(robot, dx=2.0), np.zeros(2))) == "jump"
    assert refusal(follower, Packet(1, 0.0, shifted(robot, dx=-0.29, foot=(0.39, 0, 0)))) == "reach"


# What is moved


def test_a_trunk_too_high_for_both_legs_comes_down_to_the_feet(follower: Follower, robot: Robot) -> None:
    follower.accept(Packet(1, 0.0, shifted(robot, dz=0.25)))
    found = advance(follower, 50)[-1].target
    np.testing.assert_allclose(found.ankle_positions, shifted(robot).ankle_positions, atol=1e-9)
    assert 0.79 < found.trunk_position[2] < 0.9
    assert kinematics.reachable(robot, *nodes.ankles_in_trunk_frame(found))


def test_a_trunk_too_far_ahead_of_both_feet_comes_back_to_them(follower: Follower, robot: Robot) -> None:
    ahead = shifted(robot, dx=0.28, dz=0.1)
    assert not kinematics.reachable(robot, *nodes.ankles_in_trunk_frame(ahead))
    follower.accept(Packet(1, 0.0, ahead))
    found = advance(follower, 100)[-1].target
    np.testing.assert_allclose(found.ankle_positions, ahead.ankle_positions, atol=1e-9)
    assert kinematics.reachable(robot, *nodes.ankles_in_trunk_frame(found), 1e-6)


def test_a_foot_out_of_reach_comes_to_where_the_leg_reaches(follower: Follower, robot: Robot) -> None:
    far = shifted(robot, dx=-0.1, foot=(0.35, 0, 0))
    assert not kinematics.reachable(robot, *nodes.ankles_in_trunk_frame(far))
    follower.accept(Packet(1, 0.0, far))
    found = advance(follower, 50)[-1].target
    assert kinematics.reachable(robot, *nodes.ankles_in_trunk_frame(found), 1e-6)
    np.testing.assert_allclose(found.ankle_positions, far.ankle_positions, atol=0.1)


def test_a_foot_under_the_ground_stands_on_it(robot: Robot) -> None:
    box = terrain.Box(0.3, 0.1, 0, 0, 0.3, 0.3, 0.1)
    follower = Follower(robot, footsteps.initial_nodes(robot), [box])
    follower.accept(Packet(1, 0.0, shifted(robot, foot=(0.3, 0, -0.05))))
    found = advance(follower, 60)[-1].target.ankle_positions
    assert found[0, 2] == pytest.approx(0.1 + robot.ankle_height)
    assert found[1, 2] == pytest.approx(robot.ankle_height)


# Silence


def test_after_a_silence_it_stands_over_its_feet_on_the_ground_under_them(robot: Robot) -> None:
    box = terrain.Box(0.2, 0.1, 0, 0, 0.3, 0.2, 0.05)
    follower = Follower(robot, footsteps.initial_nodes(robot), [box])
    up = shifted(robot, dx=0.05, dz=-0.1, foot=(0.15, 0, 0.12))
    up = up._replace(trunk_orientation=rotations.from_euler(*np.array([0.1, -0.1, 0.2])), ankle_yaws=np.array([0.3, 0.1]))
    follower.accept(Packet(1, 0.0, up))
    commands = advance(follower, ticks(HOLD))
    assert follower.state == "following"
    assert_equal(commands[-1].target, up)
    commands += advance(follower, ticks(0.1))
    assert follower.state == "returning" and commands[-1].timer[0] > 0 == commands[-1].timer[1]
    commands += advance(follower, ticks(2))
    assert follower.state == "standing"
    assert_smooth(commands)
    ankles, yaw = commands[-1].target.ankle_positions, rotations.from_yaw(np.float64(0.2))
    trunk = np.array([0.075, 0.0, footsteps.TRUNK_HEIGHT + 0.025])
    wanted = Nodes(
        trunk_position=footsteps.balanced(robot, Nodes(trunk, yaw, ankles, np.array([0.3, 0.1])), trunk[:2]).trunk_position,
        trunk_orientation=yaw,
        ankle_positions=np.array([[0.15, 0.1, 0.05 + robot.ankle_height], [0, -0.1, robot.ankle_height]]),
        ankle_yaws=np.array([0.3, 0.1]),
    )
    assert_equal(commands[-1].target, wanted)
    assert_equal(commands[-1].end, wanted)


def test_a_step_whose_packets_stop_goes_on_to_its_end(follower: Follower, robot: Robot) -> None:
    step = footsteps.parse(WALK, robot, "walk").steps[0]
    commands = []
    for tick in range(50):
        if tick % 4 == 0:
            now = planner.command(step, np.float64(tick * DT))
            follower.accept(Packet(tick, tick * DT, now.target, None, now.end, now.timer))
        commands.append(follower.advance())
    while follower.state == "following":
        commands.append(follower.advance())
    assert len(commands) * DT == pytest.approx(step.period, abs=4 * DT)
    assert_equal(commands[-1].target, step.end, 1e-6)
    assert_smooth(commands)
    advance(follower, ticks(1.5))
    assert follower.state == "standing"
    np.testing.assert_allclose(follower.target.ankle_positions, step.end.ankle_positions, atol=1e-6)


def test_the_time_to_hold_can_be_chosen(robot: Robot) -> None:
    follower = Follower(robot, footsteps.initial_nodes(robot), hold=1.0)
    follower.accept(Packet(1, 0.0, shifted(robot, dz=-0.1)))
    advance(follower, 200)
    assert follower.state == "following"
    advance(follower, 1)
    assert follower.state == "returning"


@pytest.mark.parametrize("pitch", [0.0, 0.3, 0.49])
def test_rates_lead_no_trunk_beyond_the_tilt_that_is_allowed(follower: Follower, robot: Robot, pitch: float) -> None:
    """Packets that come slowly are led on for up to half a second."""
    rates = NodeRates(np.zeros(3), np.array([0.0, 1.99, 0.0]), np.zeros((2, 3)), np.zeros(2))
    tilted = footsteps.initial_nodes(robot)._replace(trunk_orientation=rotations.from_euler(0.0, pitch, 0.0))
    tilts, refused = [], []
    for tick in range(800):
        if tick % 50 == 0:
            try:
                follower.accept(Packet(tick, tick * DT, tilted, rates))
            except Refused as refusal:
                refused.append(refusal.reason)
        tilts.append(rotations.to_euler(follower.advance().target.trunk_orientation)[1])
    assert max(tilts) <= 0.5
    # led on by 0.255 s, at first by two control steps
    assert refused == ["range"] * len(refused) and (pitch + 1.99 * 0.255 > 0.5) == bool(refused)


@pytest.mark.parametrize("seed", range(4))
def test_whatever_valid_packets_ask_for_the_targets_stay_smooth_and_within_reach(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    follower, commands, accepted = Follower(robot, footsteps.initial_nodes(robot)), [], 0
    for tick in range(1500):
        if rng.random() < 0.3:
            now = follower.target
            turn = rotations.from_rotation_vector(rng.uniform(-0.1, 0.1, 3))
            target = Nodes(
                now.trunk_position + rng.uniform(-0.1, 0.1, 3),
                rotations.multiply(turn, now.trunk_orientation),
                now.ankle_positions + rng.uniform(-0.1, 0.1, (2, 3)),
                now.ankle_yaws + rng.choice([-1, 0, 1], 2) * 2 * np.pi + rng.uniform(-0.5, 0.5, 2),
            )
            announced = rng.random() < 0.5
            end = (target, rng.uniform(0, 2, 2)) if announced else (None, None)
            rates = NodeRates(*(rng.uniform(-0.5, 0.5, np.shape(part)) for part in commands[-1].rates)) if commands else None
            try:
                follower.accept(Packet(tick, rng.uniform(-1, 1), target, rates, *end))
                accepted += 1
            except Refused:
                pass
        commands.append(follower.advance())
        ankles, _ = nodes.ankles_in_trunk_frame(commands[-1].target)
        nearest, _ = kinematics.project(robot, *nodes.ankles_in_trunk_frame(commands[-1].target))
        assert np.abs(nearest - ankles).max() < 0.2  # between two reachable targets
        assert commands[-1].target.ankle_positions[:, 2].min() > robot.ankle_height - 1e-6
    assert accepted > 20
    assert_smooth(commands)
