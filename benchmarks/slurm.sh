#!/bin/sh
# A sweep by a real SLURM, on this machine: two nodes of one core. The files of docs/cluster/ are run as they are, and every
# table has to equal that of a plain `jaxbl sweep`, bit for bit.
#
#     benchmarks/slurm.sh        # some three minutes on idle cores; prints what was run and "equal" for each table, or the first difference
#
# Needs: Debian's packages slurm-wlm and munge (22.05 was used; its slurmd may run several times on one machine); two cores;
# `jaxbl` and `dask` in PATH with the extra `distributed`, and dask-jobqueue; root, as slurmd changes to the user of each job.
# No systemd, no cgroups, and no SLURM that is configured already: daemons, keys and ports are its own, in a folder that is
# removed in the end. What is special to one machine in a container: node names are no hosts (NodeHostname, NodeAddr,
# slurmd -N), proctrack/linuxproc in place of cgroups, config_overrides as each node is said to have one core of more, and
# Dask on the interface lo.
set -eu
tree=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
export SLURM_CONF="$work/slurm.conf"

finish() {
    status=$?
    trap - EXIT
    for file in "$work"/*.pid; do
        kill "$(cat "$file")" 2>/dev/null || true
    done
    if [ "$status" != 0 ]; then
        echo "failed; logs are kept in $work" >&2
        exit "$status"
    fi
    # daemons write their last lines
    sleep 2
    rm -rf "$work"
}
trap finish EXIT
trap 'exit 130' INT TERM

for need in munged slurmctld slurmd sbatch jaxbl dask python; do
    command -v $need >/dev/null || { echo "needs $need (see the top of this file)" >&2; exit 2; }
done
host=$(hostname -s)
user=$(id -un)
mkdir "$work/state"
cat >"$SLURM_CONF" <<END
ClusterName=one-machine
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=26817
SlurmUser=$user
SlurmdUser=$user
AuthType=auth/munge
AuthInfo=socket=$work/munge.socket
CredType=cred/munge
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool-%n
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd-%n.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/affinity
SlurmdParameters=config_overrides
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MpiDefault=none
SchedulerParameters=sched_interval=1,batch_sched_delay=0
KillWait=2
NodeName=n[1-2] NodeHostname=$host NodeAddr=127.0.0.1 Port=[26821-26822] CPUs=1 RealMemory=4000
PartitionName=all Nodes=n[1-2] Default=YES MaxTime=INFINITE State=UP
END

( umask 077; head -c 128 /dev/urandom >"$work/munge.key" )
munged --force --key-file="$work/munge.key" --socket="$work/munge.socket" --pid-file="$work/munge.pid" \
    --log-file="$work/munge.log" --seed-file="$work/munge.seed" 2>/dev/null
slurmctld -c
for node in n1 n2; do
    slurmd -N $node
done
for _ in $(seq 60); do
    [ "$(sinfo --noheader --states=idle --format=%D)" = 2 ] && break
    sleep 0.5
done
sinfo --Node --long
srun -N2 -l sh -c 'echo "$SLURMD_NODENAME has $(nproc) core"'

# jobs start in the folder from which they are submitted
cd "$work"
cat >study.toml <<END
include = "$tree/sweeps/gain_map.toml"
[sweep]
chunk = 1024
END
# what is compiled once is not compiled by each job: that is not what is measured here
export XDG_CACHE_HOME="$work/cache" DASK_JOBQUEUE__SLURM__INTERFACE=lo DASK_JOBQUEUE__SLURM__LOCAL_DIRECTORY="$work"

compare() {
    python - plain "$1" <<'END'
import sys

import numpy as np

import jaxbl

one, other = (jaxbl.open_study(folder).frame for folder in sys.argv[1:])
assert list(one) == list(other) and len(one) == len(other), f"{sys.argv[2]}: {other.shape} is not {one.shape}"
for name in one:
    same = one[name].to_numpy().tobytes() == other[name].to_numpy().tobytes()
    assert same, f"{sys.argv[2]}: {name} differs in {np.sum(one[name].to_numpy() != other[name].to_numpy())} rows"
print(f"{sys.argv[2]}: {len(other)} rows, {len(list(other))} columns: equal")
END
}
timed() {
    begin=$(date +%s)
    echo "> $*"
    "$@"
    echo "  $(($(date +%s) - begin)) s"
}

timed jaxbl sweep study.toml --out plain

timed sbatch --wait --array=1-2 "$tree/docs/cluster/array.sbatch" study.toml array
jaxbl status array
compare array
# again: nothing is left to do
stat -c '%n %y' array/points/* >before
timed sbatch --wait --array=1-2 "$tree/docs/cluster/array.sbatch" study.toml array
stat -c '%n %y' array/points/* | diff before -

timed python "$tree/docs/cluster/slurm.py" study.toml jobqueue --jobs 2 --cores 1 --memory 2GB
compare jobqueue

# a job is lost on the way: another one takes its place
jobs() { squeue --states=all --noheader --name=dask-worker --format=%i | wc -l; }
before=$(jobs)
python "$tree/docs/cluster/slurm.py" study.toml lost --jobs 2 --cores 1 --memory 2GB &
client=$!
until [ "$(ls lost/points 2>/dev/null | wc -l)" -ge 8 ]; do
    sleep 0.2
done
victim=$(squeue --noheader --states=running --format=%i | head -1)
echo "> scancel --signal=KILL $victim, after $(ls lost/points | wc -l) parts"
scancel --signal=KILL --full "$victim"
wait $client
compare lost
echo "  $(($(jobs) - before)) jobs"
[ $(($(jobs) - before)) -ge 3 ]

# a scheduler that is there, and workers that come to it
dask scheduler --interface lo --scheduler-file scheduler.json --no-dashboard >scheduler.log 2>&1 &
echo $! >scheduler.pid
until [ -s scheduler.json ]; do
    sleep 0.2
done
sbatch --array=1-2 "$tree/docs/cluster/workers.sbatch" scheduler.json
timed jaxbl sweep study.toml --out scheduler --scheduler scheduler.json
compare scheduler
timed jaxbl sweep study.toml --out detached --scheduler scheduler.json --detach
until jaxbl status detached | grep 'all parts are there'; do
    jaxbl status detached | tail -1
    sleep 2
done
compare detached
