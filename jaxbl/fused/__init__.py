"""Fused runs: the loop over time inside, a lane's state in registers, from the same step function as the scan.

XLA makes several kernels of a time step and passes the state through memory between them. Here the traced step is split
(`split`) into what all lanes share, which is computed once, `ahead` of them, and what each lane does, which one loop does in
registers: on CPUs compiled by LLVM (`llvm`), on a GPU as one kernel (`pallas`). `passage` takes lanes through a whole run by
either; `single_plant` does what a log asks for, one plant's path and the derivatives of its steps.
"""
