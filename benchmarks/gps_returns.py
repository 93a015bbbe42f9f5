"""The picture of guided policy search: the last return of each training in gps_runs.csv (Figure 2 of the paper).

python benchmarks/gps_returns.py --update-results
"""

from __future__ import annotations

from statistics import mean

from common import CommonFlags, run
from tables import grouped, numbers

GROUPS = {"walker_short": "walker", "hopper_short": "hopper"}  # whose networks fall when the search begins
NAMES = {
    "full": "guided policy search",
    "20-units": "with 20 units",
    "one-start": "search from the last policy only",
    "nonguided": "without guides",
    "20-units-nonguided": "with 20 units, without guides",
    "unregularized": "without the regularizer",
    "effective-samples": "a bound on effective samples",
    "restart": "restarts from the guides' states",
    "single-example": "a single example, no guides",
    "policy-gradient": "policy gradient",
    "dagger": "DAgger",
}


def main(args: CommonFlags) -> None:
    from matplotlib.figure import Figure

    found = grouped(args.read("gps_runs"), "group", "cell")
    figure = Figure(figsize=(9.5, 3.2), layout="constrained")
    for axis, (group, title) in zip(
        figure.subplots(1, 2, width_ratios=(3, 2), sharey=True), GROUPS.items(), strict=True
    ):
        for place, cell in enumerate(NAMES):
            returns = numbers(found.get((group, cell), []), "end")
            axis.plot(returns, [-place] * len(returns), "C0o" if cell in ("full", "20-units") else "C1o", alpha=0.7)
        axis.axvline(mean(numbers(found[group, "full"], "guides")), color="k", linestyle="--", linewidth=1)
        axis.set(title=title, xlabel="return (dashed: guides)", xscale="symlog", yticks=range(0, -len(NAMES), -1))
        axis.set_yticklabels(NAMES.values())
        axis.set_xlim(-2600, -50)
        axis.xaxis.set_major_formatter("{x:.0f}")
        axis.grid(alpha=0.3)
    path = args.picture("gps_runs")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(path)


if __name__ == "__main__":
    run(main, CommonFlags, __doc__)
