"""The part of the command `hq` that the test needs, written with HyperQueue's Python package. It is for
machines that have the package and not the command. The server, its scheduler and its workers are the real
ones.

    hq.py server start          a server with two workers of one processor each; ends when its stdin does
    hq.py --output-mode quiet job submit-file FILE
    hq.py --output-mode quiet job list
    hq.py job wait ID

It differs from the command in two things. The workers of the package offer only processors, so the memory is
checked in the job file and not requested. The job file is read here, so the command's own reader of job files
is not tested.

The folder of the server is in HQ_SERVER_DIR, as for `hq`.
"""

import os
import re
import sys
import tomllib
from datetime import timedelta

from hyperqueue import Client, Job
from hyperqueue.cluster import LocalCluster, WorkerConfig
from hyperqueue.ffi.protocol import ResourceRequest


def serve(folder):
    with LocalCluster(folder) as cluster:
        for _ in range(2):
            cluster.start_worker(WorkerConfig(cores=1))
        print("ready", flush=True)
        sys.stdin.read()


def submit(client, path):
    with open(path, "rb") as file:
        described = tomllib.load(file)
    job, made = Job(), {}
    for task in described["task"]:
        (request,) = task["request"]
        seconds = int(re.fullmatch(r"(\d+)s", request["time_request"]).group(1))
        resources = dict(request["resources"])
        cpus, memory = resources.pop("cpus"), resources.pop("mem")
        assert memory > 0, request
        made[task["id"]] = job.program(
            task["command"],
            cwd=task["cwd"],
            stdout=task["stdout"],
            stderr=task["stderr"],
            deps=[made[number] for number in task.get("deps", [])],
            resources=ResourceRequest(cpus=cpus, resources=resources, min_time=timedelta(seconds=seconds)),
            crash_limit=task["crash_limit"],
        )
    number = client.submit(job).id
    with open(numbers(), "a") as file:
        print(number, file=file)
    print(number)


def numbers():
    """The file with the numbers of all jobs that were submitted."""
    return os.path.join(os.environ["HQ_SERVER_DIR"], "submitted")


def show_open(client):
    """Prints a line for every job that is not over. The package reports the jobs while it waits for them; one
    report is enough.
    """
    def look(jobs):
        for number, job in jobs.items():
            if not job["completed"]:
                print(number, "RUNNING")
        sys.stdout.flush()
        os._exit(0)

    with open(numbers()) as file:
        client.connection.wait_for_jobs([int(line) for line in file], look)


def main():
    folder, words = os.environ["HQ_SERVER_DIR"], sys.argv[1:]
    if words[:2] == ["--output-mode", "quiet"]:
        words = words[2:]
    if words == ["server", "start"]:
        serve(folder)
    elif words[:2] == ["job", "submit-file"]:
        submit(Client(folder), words[2])
    elif words == ["job", "list"]:
        show_open(Client(folder))
    elif words[:2] == ["job", "wait"]:
        Client(folder).connection.wait_for_jobs([int(words[2])], lambda _: None)
    else:
        sys.exit(f"hq.py: no such command: {words}")


main()
