import io

from rich.console import Console

from slotfilm_dist.presets import smoke
from slotfilm_dist.tuning.board import Board
from slotfilm_dist.tuning.jobs import Job, build_jobs, build_trials
from slotfilm_dist.tuning.ledger import Record


def board_of(num_seeds: int, **states: str) -> tuple[Board, list[Job], io.StringIO]:
    jobs = [job for job in build_jobs(build_trials(smoke(), ["state_only"], num_seeds)) if job.kind == "trial"]
    records = [
        Record(
            key=job.key,
            config_hash=job.config_hash,
            kind=job.kind,
            variant="state_only",
            seed=seed,
            state=states.get(f"s{seed}", "waiting"),  # type: ignore[arg-type]  # a JobState
        )
        for seed, job in enumerate(jobs)
    ]
    shown = io.StringIO()
    return Board(list(zip(jobs, records, strict=True)), Console(file=shown, width=120, height=20)), jobs, shown


def test_line_counts_states_and_shows_what_runs() -> None:
    board, jobs, _ = board_of(4, s0="done", s1="running")
    assert board.counts == {"done": 1, "waiting": 3}  # one that ran under a dead driver waits again
    board.note(jobs[1].key, "running")
    board.note(jobs[1].key, "running", standing={"phase": "train", "share": 0.43})
    board.note(jobs[2].key, "failed", error="ValueError: no")
    assert board.line() == f"    grid  1 done, 1 running, 1 failed, 1 waiting  | {jobs[1].key} train 43%"


def test_table_fits_the_terminal_and_puts_running_and_failed_first() -> None:
    board, jobs, shown = board_of(40, s0="done")
    board.note(jobs[30].key, "running")
    board.note(jobs[30].key, "running", standing={"phase": "train", "share": 0.5, "episode_return": 2.5})
    board.note(jobs[31].key, "failed", error="RuntimeError: [bold]not markup")
    Console(file=shown, width=120).print(board.table())
    lines = shown.getvalue().splitlines()
    assert len(lines) <= 20
    assert jobs[30].key in lines[1]
    assert "train 50%" in lines[1]
    assert "2.5" in lines[1]
    assert jobs[31].key in lines[2]
    assert "[bold]not markup" in lines[2]
    assert lines[-1].startswith("and 26 waiting")


def test_further_start_is_shown() -> None:
    board, jobs, _ = board_of(1)
    for state in ("running", "failed", "running", "done"):
        board.note(jobs[0].key, state)  # type: ignore[arg-type]  # a JobState
    assert board.rows[jobs[0].key].num_starts == 2
    assert board.rows[jobs[0].key].error == ""
