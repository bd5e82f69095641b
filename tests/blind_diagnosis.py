"""A diagnosis and an oracle that tell nothing, in a module that other processes import quickly."""


def see_nothing(logs, model, holdout):
    gap = {"holdout_rmse_before": {"theta_e": 1.0}, "holdout_rmse_after": {"theta_e": 1.0}, "noise_floor": {"theta_e": 0.1}}
    return {"verdict": "no_discrepancy", "findings": [], "gap": gap}


def fail_to_reach(case):
    raise RuntimeError("not this one")
