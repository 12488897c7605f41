"""Help in terminals of usual widths: lines break where the next word does not fit, only there."""

import itertools
import re

import pytest

from hmasd_jax.cli.main import main


@pytest.fixture(params=[80, 120])
def width(request, monkeypatch):
    """Columns of the terminal."""
    monkeypatch.setenv("COLUMNS", str(request.param))
    return request.param


def too_long(text, width):
    """List the lines that a terminal would break. tyro writes the usage."""
    lines = text.splitlines()
    return [line for line in lines if len(line) > width and not line.startswith("usage: ")]


def too_short(text):
    """List the lines of help of options that end although the next word would fit.

    A frame around them, of spaces or lines, takes two columns on either side.
    """
    helps = [line[2:-2] if re.match("[│ ] {7}", line) else "" for line in text.splitlines()]
    return [
        line
        for line, following in itertools.pairwise(helps)
        if line.strip()
        and following.strip()
        and len(f"{line.rstrip()} {following.split()[0]}") <= len(line)
    ]


def test_lines_are_found_that_break_elsewhere():
    lines = ["│       one               │", "│       two three four    │"]
    for text in ("\n".join(lines), "\n".join(lines).replace("│", " ")):
        assert too_short(text) == ["      one              "]
    assert not too_short("\n".join(reversed(lines)))
    assert too_long("usage: a b\nlonger\nlong", 5) == ["longer"]


@pytest.mark.parametrize(
    "names",
    [("alice_and_bob", "hmasd"), ("overcooked", "maser"), ("micro_battle", "eiti")],
    ids="-".join,
)
def test_settings_are_explained_in_whole_lines(names, width, capsys):
    env, algorithm = names
    assert main(["train", "--help", "--env.name", env, "--algorithm.name", algorithm]) == 0
    text = capsys.readouterr().out
    assert too_long(text, width) == []
    assert too_short(text) == []
    assert not re.search(r"(^[│ ]*\n){2}", text.strip(), re.MULTILINE)
    words = " ".join(re.sub("[│\n]", " ", text).split())
    assert "core; `vmap`, all at once in one program" in words
    assert "--env.name is one of alice_and_bob, overcooked" in words
    assert "--algorithm.name is one of edti, eiti" in words


def test_paragraphs_stay_apart(width, capsys):
    assert main(["train", "--help"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"Encoding of obs and state\.[ │]*\n[ │]+\n[ │]+`codes` is the", text)


@pytest.mark.parametrize(
    "words", [[], ["grid", "--help"], ["plot", "--help"], ["report", "--help"]], ids=str
)
def test_descriptions_fit_into_the_terminal(words, width, capsys):
    main(words)
    text = capsys.readouterr().out
    assert "usage: " in text
    assert too_long(text, width) == []
