"""Networks of PyMARL, with PyTorch's default initial weights."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from envs_jax import TimeStep
from hmasd_jax.networks.gru import gru_cell
from hmasd_jax.networks.initializers import uniform
from hmasd_jax.networks.recurrent import apply
from hmasd_jax.types import Key


class Linear(nn.Module):
    """Linear layer with PyTorch's default initial weights."""

    features: int

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
        """Map `x`."""
        kernel, bias = self.weights(x.shape[-1])
        return x @ kernel + bias

    @nn.compact
    def weights(
        self, inputs: int
    ) -> tuple[Float[Array, "inputs features"], Float[Array, " features"]]:
        """Return kernel and bias."""
        init = uniform(inputs)
        kernel = self.param("kernel", init, (inputs, self.features))
        return kernel, self.param("bias", init, (self.features,))


class AgentNet(nn.Module):
    """Linear, ReLU, GRU, Linear: values of an agent's actions (PyMARL `rnn_agent.py`)."""

    num_actions: int
    hidden_size: int

    @nn.compact
    def __call__(
        self, memory: Float[Array, "*batch hidden"], x: Float[Array, "time *batch inputs"]
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch actions"]]:
        """Run over `time` steps. Return the last memory and the values at every step."""
        size, init = self.hidden_size, uniform(self.hidden_size)
        features = nn.relu(Linear(size, name="first")(x))
        input_kernel, input_bias = Linear(3 * size, name="input").weights(size)
        kernel = self.param("kernel", init, (size, 3 * size))
        bias = self.param("bias", init, (3 * size,))

        def step(h, x):
            h = gru_cell(h, x @ input_kernel + input_bias, h @ kernel + bias)
            return h, h

        memory, hidden = jax.lax.scan(step, memory, features)
        return memory, Linear(self.num_actions, name="head")(hidden)


class VDNMixer(nn.Module):
    """VDN (Sunehag et al., 2018): the total value is the sum of the agents'."""

    def __call__(
        self, values: Float[Array, "*batch N"], state: Float[Array, "*batch state"]
    ) -> Float[Array, "*batch"]:
        """Return the total value."""
        del state
        return values.sum(-1)


class QMIXMixer(nn.Module):
    """QMIX (Rashid et al., 2018): the total value grows with each agent's, as the state decides.

    The layers that make weights from the state are single ones, as in MASER's code (`qmix.py`).
    """

    size: int

    @nn.compact
    def __call__(
        self, values: Float[Array, "*batch N"], state: Float[Array, "*batch state"]
    ) -> Float[Array, "*batch"]:
        """Return the total value."""
        num_agents = values.shape[-1]
        weight = abs(Linear(num_agents * self.size, name="weight")(state))
        weight = weight.reshape(*state.shape[:-1], num_agents, self.size)
        hidden = jnp.einsum("...n,...nh->...h", values, weight)
        hidden = nn.elu(hidden + Linear(self.size, name="bias")(state))
        last_weight = abs(Linear(self.size, name="last_weight")(state))
        bias = nn.relu(Linear(self.size, name="last_bias_hidden")(state))
        return (hidden * last_weight).sum(-1) + Linear(1, name="last_bias")(bias)[..., 0]


class DistanceNet(nn.Module):
    """Linear, ReLU, Linear: the features whose distances MASER rewards."""

    num_features: int
    hidden_size: int = 128

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch features"]:
        """Map observations to features."""
        hidden = nn.relu(Linear(self.hidden_size, name="first")(obs))
        return Linear(self.num_features, name="last")(hidden)


class AgentMemory(NamedTuple):
    """Memory of the agents between steps."""

    hidden: Float[Array, "*batch N hidden"]
    last_action: Int[Array, "*batch N"]
    """-1 before the first action of an episode."""


@dataclass(frozen=True)
class Networks:
    """The networks of an algorithm. Parameters are a dict with their names."""

    agent: AgentNet
    mixer: nn.Module

    def init(self, key: Key, timestep: TimeStep) -> dict:
        """Return initial parameters for time steps like `timestep`."""
        key_agent, key_mixer = jax.random.split(key)
        memory = self.init_memory(timestep.obs.shape[:-1])
        x = self._inputs(timestep.obs, memory.last_action)
        values = jnp.zeros(memory.last_action.shape)
        return {
            "agent": self.agent.init(key_agent, memory.hidden, x[None]),
            "mixer": self.mixer.init(key_mixer, values, timestep.state),
        }

    def init_memory(self, batch_shape: tuple[int, ...]) -> AgentMemory:
        """Return the memory before the first step, for a batch shape that ends with the agents."""
        hidden = jnp.zeros((*batch_shape, self.agent.hidden_size))
        return AgentMemory(hidden, jnp.full(batch_shape, -1, jnp.int32))

    def act(
        self, params: dict, memory: AgentMemory, timestep: TimeStep, first: Bool[Array, "*batch"]
    ) -> tuple[Float[Array, "*batch N hidden"], Float[Array, "*batch N actions"]]:
        """Return the next hidden memory and the values of all actions at a single step."""
        fresh = self.init_memory(timestep.obs.shape[:-1])
        new = first[..., None]
        hidden = jnp.where(new[..., None], fresh.hidden, memory.hidden)
        last_action = jnp.where(new, fresh.last_action, memory.last_action)
        hidden, values = self.values(params, hidden, timestep.obs[None], last_action[None])
        return hidden, values[0]

    def values(
        self,
        params: dict,
        hidden: Float[Array, "*batch N hidden"],
        obs: Float[Array, "time *batch N obs"],
        last_action: Int[Array, "time *batch N"],
    ) -> tuple[Float[Array, "*batch N hidden"], Float[Array, "time *batch N actions"]]:
        """Return the next hidden memory and the values of all actions, over steps of an episode."""
        return apply(self.agent, params["agent"], hidden, self._inputs(obs, last_action))

    def mix(
        self,
        params: dict,
        values: Float[Array, "*batch N"],
        state: Float[Array, "*batch state"],
    ) -> Float[Array, "*batch"]:
        """Return the total value of the agents' values."""
        return apply(self.mixer, params["mixer"], values, state)

    def _inputs(
        self, obs: Float[Array, "*batch N obs"], last_action: Int[Array, "*batch N"]
    ) -> Float[Array, "*batch N inputs"]:
        """Join observation, last action and index of each agent."""
        acted = jax.nn.one_hot(last_action, self.agent.num_actions)  # Zeros for -1.
        index = jnp.broadcast_to(jnp.eye(obs.shape[-2]), (*obs.shape[:-1], obs.shape[-2]))
        return jnp.concatenate([obs, acted, index], axis=-1)


@dataclass(frozen=True)
class MASERNetworks(Networks):
    """The networks of QMIX and the features of MASER."""

    distance: DistanceNet

    def init(self, key: Key, timestep: TimeStep) -> dict:
        """Return initial parameters for time steps like `timestep`."""
        key, key_distance = jax.random.split(key)
        distance = self.distance.init(key_distance, timestep.obs)
        return super().init(key, timestep) | {"distance": distance}

    def features(
        self, params: dict, obs: Float[Array, "*batch obs"]
    ) -> Float[Array, "*batch features"]:
        """Return the features of observations."""
        return apply(self.distance, params["distance"], obs)
