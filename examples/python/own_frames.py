"""Live odometry on your own frames and IMU samples: nothing is read by VIDAR.

    python own_frames.py EUROC_FOLDER trajectory.tum

Images are read by OpenCV where it is installed, else by VIDAR; they could come from a camera (`cv2.VideoCapture`), a message
queue or a simulator as well. What the odometry wants: grey or RGB arrays, nanoseconds, and IMU samples in the order of time.
"""

import pathlib
import sys

import numpy as np

import vidar

try:
    import cv2
except ImportError:
    cv2 = None


def read_image(path: pathlib.Path, recording: vidar.Recording, index: int) -> np.ndarray:
    """Pixels, uint8 (H, W)."""
    if cv2 is None:
        return recording.image(index).pixels
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def main(folder: pathlib.Path, output: pathlib.Path) -> None:
    # The calibration: here that of the folder. Written by hand it is
    # vidar.Camera("pinhole:fx,fy,cx,cy", width, height, body_from_camera=..., time_offset=...).
    recording = vidar.Recording(folder)
    camera = recording.cameras[0]
    noise = vidar.ImuNoise(**recording.imu_noise)

    imu = np.loadtxt(folder / "mav0/imu0/data.csv", delimiter=",", comments="#")
    imu_times = np.loadtxt(folder / "mav0/imu0/data.csv", delimiter=",", comments="#", usecols=0, dtype=np.int64)
    images = [line.split(",") for line in (folder / "mav0/cam0/data.csv").read_text().splitlines() if line[0] != "#"]

    odometry = vidar.Odometry(camera, noise, settings={"odometry.max_landmarks": 150})
    states, next_sample = [], 0
    for index, (time, name) in enumerate(images):
        # Samples up to and just past the image's time first, as they would arrive.
        while next_sample < len(imu_times) and imu_times[next_sample] <= int(time):
            row = imu[next_sample]
            state = odometry.push(vidar.ImuSample(int(imu_times[next_sample]), row[1:4], row[4:7]))
            states += [state] if state else []
            next_sample += 1
        pixels = read_image(folder / "mav0/cam0/data" / name.strip(), recording, index)
        state = odometry.push(vidar.Frame(index, int(time), pixels))
        states += [state] if state else []
    states += odometry.finish()

    metric = [s for s in states if s.is_metric]
    trajectory = vidar.Trajectory(np.array([s.time_ns for s in metric]), np.stack([s.world_from_body for s in metric]))
    trajectory.write(output)
    sigma = np.sqrt(np.diag(metric[-1].covariance)[3:6])
    print(f"{len(metric)} of {len(states)} images have a metric pose, path {trajectory.length:.2f} m")
    print(f"last position {trajectory.positions[-1].round(3)} m, standard deviations {sigma.round(4)} m")
    if recording.ground_truth is not None:
        scores = vidar.evaluate(trajectory, recording.ground_truth).scores
        print(f"ATE {scores['ate']:.4f} m, |ln s| {scores['scale']:.4f}")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
