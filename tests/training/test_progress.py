import io

from rich.console import Console

from hmasd_jax.training.job import Event
from hmasd_jax.training.progress import PLAIN_SECONDS, Display, clock

METRICS = {
    "success": 0.25,
    "coordinator/team_entropy": 0.6931,
    "coordinator/skill_entropy": 1.3863,
    "discriminators/team_accuracy": 0.5,
    "discriminators/individual_accuracy": 0.75,
}


def show(events, terminal, seeds=(0, 1)):
    """Return the output of a display of these seeds with 1000 env steps each."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=200)
    with Display(console, list(seeds), 1000) as display:
        for event in events:
            display.handle(event)
    return file.getvalue()


def record(kind, env_steps, wall_seconds, **metrics):
    return Event(kind, 0, {"env_steps": env_steps, "wall_seconds": wall_seconds, **metrics})


EVENTS = [
    Event("start", 0, {"env_steps": 200}),
    Event("compiled", 0, {"seconds": 31.0, "memory_bytes": 3 * 2**20, "peak_bytes": 7 * 2**20 - 1}),
    record("train", 300, 10.0, **METRICS),
    record("train", 500, 14.0, **METRICS),
    record("eval", 500, 15.0, success=0.5),
]


def test_lines_say_what_matters():
    text = show(EVENTS, terminal=False)
    assert "seed 0: resuming from env step 200" in text
    assert (
        "compiled in 31 s; predicted memory 7 MiB per process, of which arrays of the programs 3"
        in text
    )
    # 200 env steps in the 5 s since the first record; the remaining 500 take 12.5 s
    assert "40/s  ETA 0:00:12" in text
    assert "training success 25%  H(Z) 0.69  H(z) 1.39  q_D 50%  q_d 75%  evaluation 50 %" in text
    assert "\x1b" not in text


def test_a_terminal_gets_bars():
    text = show(EVENTS, terminal=True)
    assert "\x1b" in text
    assert "training success 25%  H(Z) 0.69  H(z) 1.39  q_D 50%  q_d 75%" in text


def test_one_seed_is_described_once():
    assert "all seeds 40 env steps/s" in show(EVENTS, terminal=False)
    assert show(EVENTS, terminal=False, seeds=[0]).count("ETA") == 1
    assert "all " in show(EVENTS, terminal=True)
    assert "all " not in show(EVENTS, terminal=True, seeds=[0])


def test_lines_are_rare():
    """Training records come far more often than anybody reads a log."""
    many = [record("train", 300 + i, 10.0 + i) for i in range(100)]
    assert PLAIN_SECONDS >= 10
    assert show(many, terminal=False) == ""


def test_an_end_is_told_with_its_reason():
    text = show([Event("failed", 1, {"message": "the [disk] is full"})], terminal=False)
    assert "seed 1 failed: the [disk] is full" in text


def test_clock():
    assert [clock(s) for s in (0, 59.6, 3 * 3600 + 62)] == ["0:00:00", "0:01:00", "3:01:02"]
