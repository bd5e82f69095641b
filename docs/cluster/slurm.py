"""A sweep on a SLURM cluster by dask-jobqueue, which submits the jobs, replaces those that are lost, and ends the others.

    python slurm.py STUDY.toml FOLDER --jobs 20 --cores 8 --memory 16GB

Queue, account, time limit and network interface are Dask's own settings: `jobqueue.slurm` in ~/.config/dask/jobqueue.yaml,
or DASK_JOBQUEUE__SLURM__QUEUE, .._ACCOUNT, .._WALLTIME and .._INTERFACE in the environment.
"""

import argparse

from dask_jobqueue import SLURMCluster
from distributed import Client

import jaxbl


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("study")
    parser.add_argument("folder", help="for the results: one that all nodes see, or s3://BUCKET/FOLDER")
    parser.add_argument("--jobs", type=int, default=20)
    parser.add_argument("--cores", type=int, default=8, help="of each job; a chunk of the study takes all of them")
    parser.add_argument("--memory", default="16GB", help="of each job")
    given = parser.parse_args()
    # one process a job: it uses all cores of the job, and compiles once
    with (
        SLURMCluster(cores=given.cores, processes=1, memory=given.has_memory) as cluster,
        Client(cluster) as client,
    ):
        # not scale(): that does not replace jobs that have ended
        cluster.adapt(minimum_jobs=given.jobs, maximum_jobs=given.jobs)
        result = jaxbl.sweep(given.study, given.folder, scheduler=client)
    print(f"{len(result.read(['seed']))} runs in {given.folder}; 'jaxbl plot {given.folder}' draws them")


if __name__ == "__main__":
    main()
