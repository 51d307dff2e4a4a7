"""A Slurm of its own on 127.0.0.1: munge, slurmctld and some slurmd of Debian's packages, as
ordinary processes.
"""

import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

from soak.tiny import command_line

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel", "scontrol")
PLACES = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))
MISSING = [name for name in PROGRAMS if shutil.which(name, path=PLACES) is None]
WHY = f"{', '.join(MISSING)} not found: apt-get install --no-install-recommends munge slurm-wlm"
if not MISSING and find_spec("snakemake_executor_plugin_slurm") is None:
    MISSING, WHY = (
        ["the extra slurm"],
        ("Snakemake's plugin for Slurm is not installed: make cluster-test does"),
    )

CONF = """\
ClusterName=here
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
SlurmdTimeout=10
ReturnToService=2
KillWait=10
SchedulerParameters=batch_sched_delay=0,sched_min_interval=0
"""


class Slurm:
    """A cluster under way. `environment`: what makes Slurm's commands, here and within jobs, talk
    to it.
    """

    def __init__(self, folder, n_nodes, cpus):
        self.folder, self.processes = folder, {}
        bound = [socket.socket() for _ in range(n_nodes + 1)]
        for one in bound:
            one.bind(("127.0.0.1", 0))
        ports = [one.getsockname()[1] for one in bound]
        for one in bound:
            one.close()
        host, user = (
            socket.gethostname().split(".")[0],
            subprocess.check_output(["id", "-un"], text=True).strip(),
        )
        text = CONF.format(host=host, user=user, folder=folder, ports=ports)
        self.nodes = [f"n{k}" for k in range(1, n_nodes + 1)]
        for name, port in zip(self.nodes, ports[1:], strict=True):
            text += (
                f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} "
                f"CPUs={cpus} RealMemory=64000\n"
            )
        text += (
            f"PartitionName=all Nodes={','.join(self.nodes)} Default=YES MaxTime=INFINITE "
            "State=UP\n"
        )
        (folder / "slurm.conf").write_text(text)
        for name in ("state", "bin"):
            (folder / name).mkdir()
        # Snakemake's plugin takes SLURM_* from what a job runs: its srun has to be told where this
        # cluster is.
        srun = folder / "bin/srun"
        srun.write_text(
            f"#!/bin/sh\nSLURM_CONF={folder}/slurm.conf exec "
            f'{shutil.which("srun", path=PLACES)} "$@"\n'
        )
        srun.chmod(0o755)
        path = os.pathsep.join((str(folder / "bin"), PLACES))
        self.environment = {"SLURM_CONF": str(folder / "slurm.conf"), "PATH": path}

    def start(self, name, *command):
        with open(self.folder / f"{name}.words", "ab") as words:
            self.processes[name] = subprocess.Popen(
                [shutil.which(command[0], path=PLACES), *command[1:]],
                env=os.environ | self.environment,
                stdin=subprocess.DEVNULL, stdout=words, stderr=words, start_new_session=True,
            )  # fmt: skip

    def start_node(self, name):
        self.start(name, "slurmd", "-D", "-N", name, "-f", self.folder / "slurm.conf")

    def start_all(self):
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        places = {"socket": "munge.socket", "key-file": key.name, "pid-file": "munge.pid",
                  "log-file": "munge.log",
                  "seed-file": "munge.seed"}  # fmt: skip
        self.start("munge", "munged", "--foreground", "--force",
                   *(f"--{option}={self.folder / file}"
                     for option, file in places.items()))  # fmt: skip
        self.wait_for(lambda: (self.folder / "munge.socket").exists(), "munge", 20)
        self.start("slurmctld", "slurmctld", "-D", "-c", "-f", self.folder / "slurm.conf")
        for name in self.nodes:
            self.start_node(name)
        self.wait_for(lambda: self.states().count("idle") == len(self.nodes), "slurmctld", 60)

    def wait_for(self, condition, name, seconds):
        until = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < until, (self.folder / f"{name}.words").read_text()[-2000:]
            time.sleep(0.1)

    def ask(self, *command):
        done = subprocess.run(
            command, env=os.environ | self.environment, capture_output=True, text=True
        )
        return done.stdout.splitlines()

    def states(self):
        return self.ask("sinfo", "--noheader", "--Node", "--format=%t")

    def node_of(self, key):
        """The node that makes an artifact; None: not one."""
        for node in self.nodes:
            if any(f" {key} " in command_line(number) for number in self.at_work(node)):
                return node
        return None

    def at_work(self, node=""):
        """Processes of jobs on a node, or on all, and of the slurmstepd above them, which leave the
        slurmd's tree.
        """
        found = set()
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                words = (folder / "environ").read_bytes()
                if (
                    f"SLURMD_NODENAME={node}".encode() in words
                    and f"{self.folder}/bin".encode() in words
                ):
                    found.add(int(folder.name))
        for number in list(found):
            with suppress(OSError):
                above = parent_of(number)
                if "slurmstepd" in command_line(above):
                    found.add(above)
        return found

    def fell(self, node):
        """Kill a node with all that runs on it, as a power cut would."""
        process = self.processes.pop(node)
        process.kill()
        kill_all(self.at_work(node))
        process.wait()

    def stop_all(self):
        for process in reversed(self.processes.values()):
            process.terminate()
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        kill_all(self.at_work())


def parent_of(number):
    return int(Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[1])


def kill_all(numbers):
    for number in numbers:
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)


@contextmanager
def slurm(folder, n_nodes=3, cpus=1):
    cluster = Slurm(folder, n_nodes, cpus)
    try:
        cluster.start_all()
        yield cluster
    finally:
        cluster.stop_all()
