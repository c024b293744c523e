"""Progress: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import io
import logging

from scanloom.pipeline.progress import Bars, Lines, progress_for
from scanloom.pipeline.run import run
from tests.pipeline.toys.workflow import log, request


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_lines_say_each_stage_once_it_is_done(tmp_path, store, caplog):
    sessions = [log(tmp_path, "a", range(30)), log(tmp_path, "bad", range(5), "broken")]
    with caplog.at_level(logging.INFO, logger="scanloom.progress"):
        run(request(*sessions), store, cluster="none", progress=progress_for(io.StringIO()))
    lines = [record.getMessage() for record in caplog.records]
    assert any(line.endswith("smooth: 3 of 3") for line in lines)
    assert any(line.startswith("read failed: read session=bad: log: the log is broken") for line in lines)
    assert sum("survey" in line for line in lines) == 1


def test_a_stage_that_was_skipped_is_not_said_to_be_done(tmp_path, store, caplog):
    with caplog.at_level(logging.INFO, logger="scanloom.progress"):
        run(request(log(tmp_path, "bad", range(5), "broken")), store, cluster="none", progress=Lines())
    lines = [record.getMessage() for record in caplog.records]
    assert any("read failed" in line for line in lines)
    assert not any("smooth" in line or "survey" in line for line in lines)


def test_bars_on_a_terminal(tmp_path, store):
    terminal = Terminal()
    progress = progress_for(terminal)
    assert isinstance(progress, Bars)
    assert isinstance(progress_for(io.StringIO()), Lines)
    run(request(log(tmp_path, "a", range(30))), store, cluster="none", progress=progress)
    assert "survey" in terminal.getvalue()


def test_long_stages_are_said_with_the_time_left(caplog, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("scanloom.pipeline.progress.time.monotonic", lambda: clock[0])
    lines = Lines(every_s=30.0)
    with caplog.at_level(logging.INFO, logger="scanloom.progress"):
        lines.begin([("laz", "laz (a cloud)")])
        for over in range(40):
            lines.update({"laz": (over, 1, 40)})
            clock[0] += 5.0
        lines.update({"laz": (40, 0, 40)})
    said = [record.getMessage() for record in caplog.records]
    assert said[0] == "  35.0 s  laz (a cloud): 7 of 40, about 165 s left"
    assert said[-1] == " 200.0 s  laz (a cloud): 40 of 40"
    assert len(said) == 6
