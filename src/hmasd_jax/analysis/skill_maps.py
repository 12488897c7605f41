"""Maps of the skills learned on Alice_and_Bob, as in the paper's Figs. 4 and 9."""

from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from envs_jax import alice_and_bob
from envs_jax.alice_and_bob import AliceAndBob
from envs_jax.declared import describe_agents
from envs_jax.optional import require
from hmasd_jax.analysis.episodes import play
from hmasd_jax.analysis.figures import save
from hmasd_jax.runs.folder import RunError
from hmasd_jax.runs.load import TrainedRun, check_skills, load_run, make_policy

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_skills(
    run: Path, out: Path, seed: int = 0, step: int | None = None, episodes: int = 200
) -> Path:
    """Draw the cells that each individual skill visits, and the skills that each Z assigns.

    A map shows the share of time that an agent spends in each cell. All agents follow the skill
    from random starts, and the second half of a skill interval counts. The table beside the maps
    shows how often the coordinator assigns each z to the agent while Z is held. Skills and actions
    are chosen by arg-max.

    Args:
        run: Folder of a run of HMASD on Alice_and_Bob, finished or still running.
        out: Image to write. Its suffix selects the format.
        seed: Index of the seed in the run.
        step: Environment steps of the checkpoint; None selects the newest.
        episodes: Number of random starts per skill.

    Returns:
        `out`.

    Raises:
        MissingPackageError: matplotlib is not installed.
        RunError: `run` is not the folder of a run, has no such seed, no skills or another
            environment, or `out` cannot be written.
        CheckpointError: There is no such checkpoint, or it is damaged.
    """
    require("matplotlib", "plots", "plotting")
    from matplotlib.figure import Figure

    trained = load_run(run, seed, step)
    if not isinstance(trained.env, AliceAndBob):
        raise RunError(f"{run} is not a run on alice_and_bob, the only environment with maps")
    check_skills(trained)
    visits = visitation(trained, episodes)  # (skills, agents, rows, columns)
    choices = coordinator_choices(trained, episodes)  # (team skills, agents, skills)
    num_skills, num_agents = visits.shape[:2]
    size = (2.1 * (num_skills + 1), 2.2 * num_agents + 0.3)
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    axes = figure.subplots(num_agents, num_skills + 1, squeeze=False)
    for agent, (name, _) in enumerate(describe_agents(trained.env)):
        for skill in range(num_skills):
            _draw_map(axes[agent, skill], visits[skill, agent])
            axes[0, skill].set_title(f"z = {skill}", fontsize=10)
        axes[agent, 0].set_ylabel(name)
        _draw_table(axes[agent, -1], choices[:, agent])
    axes[0, -1].set_title("coordinator's z", fontsize=10)
    figure.suptitle(f"{Path(run).resolve().name}, seed {seed}, env step {trained.env_steps:,}")
    return save(figure, out)


def visitation(trained: TrainedRun, episodes: int) -> np.ndarray:
    """Return the share of time per cell, (skills, agents, rows, columns)."""
    config, env = trained.config.algorithm, trained.env
    keys = jax.random.split(jax.random.key(0), episodes)
    end = min(config.skill_interval, env.max_steps)
    maps = np.zeros((config.num_skills, env.num_agents, *alice_and_bob.BOARD.shape))
    for skill in range(config.num_skills):
        policy = make_policy(trained, (None, *[skill] * env.num_agents))
        env_states, timesteps, *_ = jax.device_get(play(env, policy, keys))
        # (E, T + 1): True up to the end of the episode; later steps are meaningless.
        alive = np.cumsum(timesteps.done, axis=1) - timesteps.done == 0
        times = np.arange(alive.shape[1])
        counted = alive & (times > end // 2) & (times <= end)
        for agent in range(env.num_agents):
            rows, columns = env_states.position[counted][:, agent].T
            np.add.at(maps[skill, agent], (rows, columns), 1.0 / max(counted.sum(), 1))
    return maps


def coordinator_choices(trained: TrainedRun, episodes: int) -> np.ndarray:
    """Return the frequency of each z at the first step, (team skills, agents, skills)."""
    config, env = trained.config.algorithm, trained.env
    keys = jax.random.split(jax.random.key(1), episodes)
    shares = np.zeros((config.num_team_skills, env.num_agents, config.num_skills))
    for team_skill in range(config.num_team_skills):
        policy = make_policy(trained, (team_skill, *[None] * env.num_agents))
        chosen = jax.device_get(play(env, policy, keys)).extras[:, 0, 1:]  # (E, agents)
        shares[team_skill] = (chosen[..., None] == np.arange(config.num_skills)).mean(axis=0)
    return shares


def _draw_map(axes: "Axes", visits: np.ndarray) -> None:
    """Draw a board, darker in cells with more visits, with outlined buttons and diamonds."""
    axes.imshow(np.sqrt(visits), cmap="Greys", vmin=0, vmax=1)  # the root shows rare cells too
    for cells, marker in ((alice_and_bob.BUTTONS, "s"), (alice_and_bob.DIAMONDS, "D")):
        for (row, column), name in zip(cells, ("red", "blue")):
            color = np.array(alice_and_bob.COLORS[name]) / 255
            axes.plot(column, row, marker, color=color, fillstyle="none", markersize=9, mew=2)
    inside = (0.5, alice_and_bob.SIZE + 0.5)
    axes.set(xlim=inside, ylim=inside[::-1], xticks=[], yticks=[])


def _draw_table(axes: "Axes", shares: np.ndarray) -> None:
    """Draw a table of percentages from shares (team skills, skills)."""
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for (row, column), share in np.ndenumerate(shares):
        color = "white" if share > 0.5 else "black"
        axes.text(column, row, f"{share:.0%}", ha="center", va="center", color=color, fontsize=7)
    team_skills, skills = shares.shape
    axes.set_xticks(range(skills), [f"z={i}" for i in range(skills)], fontsize=7)
    axes.set_yticks(range(team_skills), [f"Z={i}" for i in range(team_skills)], fontsize=7)
    axes.tick_params(length=0)
