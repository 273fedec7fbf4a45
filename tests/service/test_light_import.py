"""Importing the service, or asking for help, loads no compute kernel, plotter or file library."""

import json
import subprocess
import sys

import pytest

HEAVY = {"warp", "matplotlib", "h5py", "nats", "nkeys"}


def loaded_by(code: str) -> set[str]:
    """Top-level modules that a new interpreter has after running the code."""
    report = (
        "import json, sys; print(json.dumps(sorted({m.partition('.')[0] for m in sys.modules})))"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "import service",
        "import service.application.app",
        "from service.cli.serve import openapi; openapi()",
        "import service.cli.serve",
    ],
)
def test_heavy_libraries_stay_out(code: str):
    loaded = loaded_by(code)
    assert "service" in loaded
    assert not loaded & HEAVY


def test_a_worker_process_loads_neither_the_server_nor_the_database():
    # What runs, reports and uploads call in their processes; all kinds of runs.
    loaded = loaded_by(
        "import importlib, pkgutil\n"
        "import service.api.correction_tables.upload_process, service.jobs.worker\n"
        "import service.api.reports.render_process\n"
        "import service.api.runs.kinds as kinds\n"
        "names = [found.name for found in pkgutil.iter_modules(kinds.__path__)]\n"
        "assert 'calibration' in names\n"
        "for name in names: importlib.import_module(f'{kinds.__name__}.{name}')"
    )
    assert {"compute", "pydantic"} <= loaded
    assert not loaded & (HEAVY | {"fastapi", "starlette", "sqlalchemy", "alembic", "uvicorn"})


def test_help_loads_nothing_but_the_command_line():
    help_page = (
        "import contextlib, sys\n"
        "from service.cli import main\n"
        "sys.argv = ['lumiline', '--help']\n"
        "with contextlib.suppress(SystemExit): main()"
    )
    loaded = loaded_by(help_page)
    assert {"service", "typer"} <= loaded
    assert not loaded & (HEAVY | {"numpy", "scipy", "fastapi", "sqlalchemy", "uvicorn"})


def test_command_line_import_leaves_numpy_out_so_that_its_threads_can_be_set():
    assert "numpy" not in loaded_by("import service.cli")


def test_command_line_runs_linear_algebra_in_one_thread_unless_the_environment_says_otherwise():
    code = (
        "import os, sys, service.cli\n"
        "os.environ.pop('OPENBLAS_NUM_THREADS', None); os.environ['OMP_NUM_THREADS'] = '2'\n"
        "sys.argv = ['lumiline', '--version']\n"
        "try:\n    service.cli.main()\nexcept SystemExit:\n    pass\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'], os.environ['OMP_NUM_THREADS'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "1 2"
