"""PostgreSQL restarted under load: requests fail cleanly, and go on when it is back."""

import os
import pwd
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.service.crash.clients import Clients
from tests.service.crash.process import ServiceProcess
from tests.service.crash.test_kill import check_activations, check_calibrations


class Cluster:
    """A PostgreSQL server of the test's own, in a folder."""

    def __init__(self, folder: Path, programs: Path) -> None:
        self._data, self._programs = folder / "cluster", programs
        # It refuses to run as root.
        self._user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        if self._user:
            shutil.chown(folder, "postgres")
        self._run("initdb", "-D", str(self._data), "-U", "lumiline", "--auth=trust", "--no-sync")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self.url = f"postgresql+psycopg://lumiline@127.0.0.1:{self.port}/postgres"

    def start(self) -> None:
        options = f"-p {self.port} -k {self._data} -c listen_addresses=127.0.0.1"
        log = str(self._data / "log")
        self._run("pg_ctl", "-D", str(self._data), "-w", "-l", log, "-o", options, "start")

    def stop(self, how: str) -> None:
        self._run("pg_ctl", "-D", str(self._data), "-w", "-m", how, "stop")

    def _run(self, program: str, *arguments: str) -> None:
        command = [*self._user, str(self._programs / program), *arguments]
        subprocess.run(command, check=True, cwd="/", stdout=subprocess.DEVNULL)


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    program = shutil.which("initdb") or (str(found[-1]) if found else None)
    if program is None:
        pytest.skip("PostgreSQL's initdb is not installed")
    if os.geteuid() == 0:
        try:
            pwd.getpwnam("postgres")
        except KeyError:
            pytest.skip("root cannot run PostgreSQL, and there is no user postgres")
    # Not below pytest's folder, which is its user's alone.
    folder = Path("/tmp") / f"lumiline-cluster-{os.getpid()}"
    folder.mkdir(mode=0o755)
    made = Cluster(folder, Path(program).parent)
    made.start()
    try:
        yield made
    finally:
        subprocess.run([*made._user, str(made._programs / "pg_ctl"), "-D", str(made._data),
                        "-m", "immediate", "stop"], cwd="/", check=False,
                       stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
        shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.postgres
def test_requests_fail_cleanly_and_recover(cluster: Cluster, tmp_path: Path) -> None:
    service = ServiceProcess(tmp_path, cluster.url)
    service.start()
    clients = Clients(service.url, "c")
    try:
        clients.start()
        for how in ("fast", "immediate"):  # the second as if it had crashed
            time.sleep(0.7)
            cluster.stop(how)
            time.sleep(0.3)
            answer = httpx.get(f"{service.url}/api/v1/devices", timeout=30.0)
            assert (answer.status_code, answer.json()["type"]) == (503, "/problems/not-ready")
            assert httpx.get(f"{service.url}/readyz", timeout=30.0).status_code == 503
            assert httpx.get(f"{service.url}/healthz", timeout=30.0).status_code == 200
            cluster.start()
            end = time.monotonic() + 240.0
            while httpx.get(f"{service.url}/readyz", timeout=30.0).status_code != 200:
                assert time.monotonic() < end, "it does not find its database again"
                time.sleep(0.05)
            before = len(clients.calibrations), len(clients.activations)
            while not all(
                now > then
                for now, then in zip(
                    (len(clients.calibrations), len(clients.activations)), before, strict=True
                )
            ):
                assert time.monotonic() < end, "clients do not get on"
                time.sleep(0.05)
        clients.stop()
        # Every client went on, and what it was refused was told as it should be.
        assert clients.failures == []
        assert clients.refused
        for answer in clients.refused:
            problem = answer.json()
            assert (answer.status_code, problem["type"]) == (503, "/problems/not-ready")
            assert "lumiline@" not in answer.text
        check_calibrations(service.url, clients.calibrations)
        check_activations(service.url, clients)
        assert "Traceback" not in service.log
    finally:
        clients.stop()
        service.stop()
