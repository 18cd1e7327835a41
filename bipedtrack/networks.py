"""Brax's actor and critic: how they are made, their parameters as arrays of a checkpoint, and the policy that ships."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training import networks as brax_networks
from brax.training import types
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from flax import linen

from bipedtrack import balance, curriculum, observation, policy, robot, symmetry
from bipedtrack.checkpoint import CheckpointError
from bipedtrack.robot import Robot

_ACTIVATIONS = {"swish": linen.swish, "tanh": linen.tanh, "relu": linen.relu}
assert set(_ACTIVATIONS) == set(policy.ACTIVATIONS)

Params = Any  # brax's (normaliser state, policy parameters, value parameters)


def make(
    network: curriculum.NetworkConfig, *args: Any, the_robot: Robot | None = None, **kwargs: Any
) -> ppo_networks.PPONetworks:
    """Brax's actor and critic, as a `network_factory`: Gaussian actions whose deviation is learned, not squashed.

    `the_robot` is the one whose balance the critic sees, if it does.
    """
    made = ppo_networks.make_ppo_networks(
        *args,
        **kwargs,
        policy_hidden_layer_sizes=network.actor,
        value_hidden_layer_sizes=network.critic,
        activation=_ACTIVATIONS[network.activation],
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=network.initial_noise,
    )
    if network.critic_sees_balance:
        assert the_robot is not None
        normalize = kwargs.get("preprocess_observations_fn", types.identity_observation_preprocessor)
        made = dataclasses.replace(made, value_network=_balance_critic(network, the_robot, normalize))
    return _symmetric(made) if network.symmetric else made


def _balance_critic(
    network: curriculum.NetworkConfig, the_robot: Robot, normalize: types.PreprocessObservationFn
) -> brax_networks.FeedForwardNetwork:
    """Brax's critic, shown the robot's balance beside the normalised observation."""

    def shown(flat: jax.Array, normalizer: Any) -> jax.Array:
        return jnp.concatenate([normalize(flat, normalizer), balance.features(the_robot, flat)], axis=-1)

    return brax_networks.make_value_network(
        observation.SIZE + balance.SIZE,
        preprocess_observations_fn=shown,
        hidden_layer_sizes=network.critic,
        activation=_ACTIVATIONS[network.activation],
    )


def _symmetric(made: ppo_networks.PPONetworks) -> ppo_networks.PPONetworks:
    """The networks shown the mirror image where the right foot leads, their actions mirrored back."""

    def act(normalizer: Any, params: Any, flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        shown, right = symmetry.canonical(flat)
        mean, deviation = made.policy_network.apply(normalizer, params, shown)
        return symmetry.restored(mean, right), jnp.where(right, symmetry.swapped(deviation), deviation)

    def value(normalizer: Any, params: Any, flat: jax.Array) -> jax.Array:
        return made.value_network.apply(normalizer, params, symmetry.canonical(flat)[0])

    return dataclasses.replace(
        made,
        policy_network=dataclasses.replace(made.policy_network, apply=act),
        value_network=dataclasses.replace(made.value_network, apply=value),
    )


def with_noise(params: Params, noise: float) -> Params:
    """The parameters with another standard deviation of the actions, the same for all of them."""
    normalizer, actor, critic = params
    deviation = jax.tree.map(lambda log: jnp.full_like(log, math.log(noise)), actor["params"]["std_logparam"])
    return normalizer, {**actor, "params": {**actor["params"], "std_logparam": deviation}}, critic


def template(config: curriculum.Curriculum) -> Params:
    """Shapes and types of the parameters, without computing any."""

    def build() -> Params:
        the_robot = robot.load(config.robot)
        made = make(config.network, observation.SIZE, len(the_robot.joint_names), the_robot=the_robot)
        key = jax.random.PRNGKey(0)
        normalizer = running_statistics.init_state(
            specs.Array((observation.SIZE,), np.dtype("float32")), std_eps=config.network.normalizer_floor
        )
        return normalizer, made.policy_network.init(key), made.value_network.init(key)

    return jax.eval_shape(build)


def _named_leaves(params: Params) -> tuple[dict[str, Any], Any]:
    """The leaves by their path, and the tree's structure."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(params)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}, structure


def to_arrays(params: Params) -> dict[str, np.ndarray]:
    """Brax's parameters as named arrays for a checkpoint."""
    return {name: np.asarray(leaf) for name, leaf in _named_leaves(params)[0].items()}


def from_arrays(config: curriculum.Curriculum, arrays: dict[str, np.ndarray]) -> Params:
    """Brax's parameters from a checkpoint's arrays, with the curriculum's own `normalizer_floor` from now on.

    Raises CheckpointError where they do not fit the curriculum.
    """
    wanted, structure = _named_leaves(template(config))
    if set(wanted) != set(arrays):
        odd = sorted(set(wanted) ^ set(arrays))[0]
        raise CheckpointError(f"checkpoint does not fit the curriculum's networks: {odd} is on one side only")
    for name, leaf in wanted.items():
        if arrays[name].shape != leaf.shape or arrays[name].dtype != leaf.dtype:
            raise CheckpointError(
                f"checkpoint does not fit the curriculum's networks: {name} is {arrays[name].dtype}"
                f"{list(arrays[name].shape)}, wanted {leaf.dtype}{list(leaf.shape)}"
            )
    normalizer, actor, critic = jax.tree_util.tree_unflatten(structure, [jnp.asarray(arrays[name]) for name in wanted])
    floor = jnp.full_like(normalizer.std_eps, config.network.normalizer_floor)
    return normalizer.replace(std_eps=floor), actor, critic


def to_policy(
    config: curriculum.Curriculum, arrays: dict[str, np.ndarray], provenance: dict[str, Any], call: int = 0
) -> policy.Policy:
    """The exported policy of a checkpoint's arrays: the actor's mean, its normaliser and all that surrounds them.

    `call` is the last finished one: control law and sway are those of its stage.
    """
    stage = curriculum.calls(config)[max(call, 0)].stage
    normalizer, actor, _ = from_arrays(config, arrays)
    layers = actor["params"]["MLP_0"]
    dense = [layers[f"hidden_{i}"] for i in range(len(config.network.actor))] + [actor["params"]["Dense_0"]]
    return policy.Policy(
        network=policy.Network(
            mean=np.asarray(normalizer.mean),
            std=np.asarray(normalizer.std),
            weights=tuple(np.asarray(layer["kernel"]) for layer in dense),
            biases=tuple(np.asarray(layer["bias"]) for layer in dense),
        ),
        activation=config.network.activation,
        settings=curriculum.control_of(config, stage),
        policy_period=config.policy_period,
        robot=robot.load(config.robot),
        provenance=provenance,
        symmetric=config.network.symmetric,
        sway=curriculum.ranges_of(config, stage).usual_sway,
    )
