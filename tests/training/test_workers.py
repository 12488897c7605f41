import subprocess
import sys


def test_a_worker_that_lacks_the_environment_says_so(tmp_path):
    """Registering behind `if __name__ == "__main__"` reaches the parent alone."""
    script = tmp_path / "mine.py"
    script.write_text(
        "import sys, envs_jax, hmasd_jax.cli.main as commands\n"
        "if __name__ == '__main__':\n"
        "    envs_jax.register('mine', envs_jax.registry.ENVIRONMENTS['alice_and_bob'])\n"
        "    del envs_jax.registry.ENVIRONMENTS['alice_and_bob']\n"
        "    sys.exit(commands.main())\n"
    )
    run = tmp_path / "run"
    command = ["seed_sweep", "--env.name", "mine", "--placement", "workers", "--num-seeds", "1"]
    done = subprocess.run(
        [sys.executable, script, *command, "--run-dir", run], capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "seed 0 failed: unknown env.name 'mine'" in done.stdout + done.stderr
    assert "register your own" in (run / "seed_0" / "error.txt").read_text()
