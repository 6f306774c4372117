"""A trajectory evaluated by VIDAR and by evo, which must agree.

    python with_evo.py ESTIMATE.tum TRUTH.tum        # needs: pip install evo
"""

import pathlib
import sys

from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D

import vidar


def for_evo(trajectory: vidar.Trajectory) -> PoseTrajectory3D:
    """The same poses; evo's quaternions have their scalar first, its times are seconds."""
    return PoseTrajectory3D(
        positions_xyz=trajectory.positions,
        orientations_quat_wxyz=trajectory.quaternions_xyzw[:, [3, 0, 1, 2]],
        timestamps=trajectory.times_ns * 1e-9,
    )


def ate_of_evo(estimate: vidar.Trajectory, truth: vidar.Trajectory, with_scale: bool) -> float:
    """RMSE of positions after the best fit, metres."""
    reference, moved = sync.associate_trajectories(for_evo(truth), for_evo(estimate), max_diff=0.01)
    moved.align(reference, correct_scale=with_scale)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, moved))
    return ape.get_statistic(metrics.StatisticsType.rmse)


def main(estimate_file: pathlib.Path, truth_file: pathlib.Path) -> None:
    estimate, truth = vidar.Trajectory.read(estimate_file), vidar.Trajectory.read(truth_file)
    scores = vidar.evaluate(estimate, truth).scores
    for name, with_scale in [("ate", False), ("ate-sim3", True)]:
        other = ate_of_evo(estimate, truth, with_scale)
        print(f"{name}: VIDAR {scores[name]:.9f} m, evo {other:.9f} m")
        assert abs(scores[name] - other) < 1e-6, "VIDAR and evo disagree"


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
