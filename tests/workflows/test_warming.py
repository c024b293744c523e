"""What a command and its workers load, and when."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import numpy as np

from scanloom.stages.geometry import kernels
from scanloom.stages.geometry.voxels import downsample
from scanloom.workflows import warming


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_command_that_only_plans_and_waits_needs_no_numerics():
    code = "import sys, scanloom.workflows.build_map; print(*{'numba', 'scipy', 'gtsam', 'distributed'} & {*sys.modules})"
    assert run_python(code) == ""


def test_workers_start_with_numba_and_find_the_kernels_compiled_before(tmp_path, monkeypatch):
    downsample(np.zeros((3, 3), np.float32), 1.0)
    monkeypatch.setattr(kernels, "cache_folder", lambda: tmp_path)
    kernels.remember_signatures()
    loaded = sum(1 for _ in kernels.load_kernels())
    used = [each for each in kernels._KERNELS if "compiled" in vars(each)]
    assert loaded == sum(len(each.compiled.signatures) for each in used) > 0


def test_without_a_cache_nothing_is_loaded_and_nothing_breaks(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "cache_folder", lambda: tmp_path / "none")
    assert list(kernels.load_kernels()) == []
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "signatures.pickle").write_bytes(b"\x80")
    assert list(kernels.load_kernels()) == []


def test_another_checkout_and_other_code_have_a_cache_of_their_own(tmp_path, monkeypatch):
    folders = []
    for place, code in (("a", "A = 1"), ("b", "A = 1"), ("a", "A = 2")):
        module = tmp_path / place / "stages" / "geometry" / "kernels.py"
        module.parent.mkdir(parents=True, exist_ok=True)
        module.write_text(code)
        monkeypatch.setattr(kernels, "__file__", str(module))
        folders.append(kernels.cache_folder.__wrapped__())
    assert len(set(folders)) == 3
    assert folders[-1] == kernels.cache_folder.__wrapped__()


def test_kernels_load_between_tasks_only():
    code = """
import threading, time
from scanloom.pipeline import task
import scanloom.workflows.warm_workers as warm
warm._kernels, warm.LATER = iter(range(3)), ("colorsys",)
task._under_way.add("x")
side = threading.Thread(target=warm.load_while_idle)
side.start(); time.sleep(0.2)
import sys
busy = "colorsys" in sys.modules, next(warm._kernels, None)
task._under_way.clear(); side.join(5)
print(busy, "colorsys" in sys.modules)
"""
    assert run_python(code) == "(False, 1) True"


def test_workers_start_without_scipy_and_can_import_it():
    code = """
import sys
import scanloom.workflows.warm_workers
before = "scipy.linalg" in sys.modules
import scipy.linalg
print(before, scipy.linalg.norm([3.0, 4.0]))
"""
    assert run_python(code) == "False 5.0"


def test_modules_are_compiled_also_where_python_is_told_not_to(tmp_path, monkeypatch):
    (tmp_path / "thing.py").write_text("A = 1\n")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(warming, "import_module", lambda name: SimpleNamespace(__path__=[str(tmp_path)]))
    warming.compile_modules()
    assert len(list(tmp_path.glob("__pycache__/thing.*.pyc"))) == 1
    (tmp_path / "thing.py").write_text("A = (\n")
    warming.compile_modules()  # what does not compile says so when it is imported


def test_garbage_is_collected_in_workers_only():
    code = """
import gc, os
import scanloom.pipeline.local_worker
child = os.fork()
if not child:
    os._exit(gc.isenabled() and gc.get_freeze_count() > 1000)
print(gc.isenabled(), os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert run_python(code) == "False 1"
