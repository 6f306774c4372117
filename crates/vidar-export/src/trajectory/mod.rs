//! Trajectories as other tools read them: TUM, EuRoC csv, KITTI.
//!
//! All three hold `world_from_body` in metres; quaternions are unit, with w ≥ 0 when written. Times never pass
//! through floating point. TUM and EuRoC files name the body in a comment (`# world_from_body, body = camera0`);
//! KITTI has no comments, so its body and times are in a second file. A file without that comment is read as poses
//! of [`BodyFrame::Other`]: the body is not guessed.
//!
//! Digits: TUM and EuRoC numbers have nine decimals, so a position is exact to 0.5 nm and a rotation to about
//! 1e-9 rad, far below any sensor. KITTI matrices have thirteen significant digits, because rounding a
//! rotation matrix takes it off the group. NaN: a [`Trajectory`] cannot hold one, and a file that does is an error.

mod euroc;
mod kitti;
mod tum;

pub use euroc::{read_euroc_csv, write_euroc_csv};
pub use kitti::{KittiTimes, read_kitti, read_kitti_times, write_kitti, write_kitti_times};
pub use tum::{read_tum, write_tum};

use crate::error::ExportError;
use crate::text::Line;
use nalgebra::Vector3;
use std::io::{self, Write};
use vidar_core::trajectory::{BodyFrame, StampedPose, Trajectory};
use vidar_core::{CameraId, Se3, So3, Timestamp};

/// Largest deviation of a quaternion's length from 1 that is accepted as rounding of printed digits.
const QUATERNION_LENGTH_TOLERANCE: f64 = 1e-2;

/// Writes the comment that names the frames, and the caller's note, one comment line per line.
fn write_header(w: &mut impl Write, body: BodyFrame, note: &str) -> io::Result<()> {
    writeln!(w, "# world_from_body, body = {body}")?;
    for line in note.lines() {
        writeln!(w, "# {}", line.trim())?;
    }
    Ok(())
}

/// The body named by a comment written by `write_header`.
fn body_of_comment(line: &Line<'_>) -> Result<Option<BodyFrame>, ExportError> {
    let Some(rest) = line.comment().and_then(|c| c.strip_prefix("world_from_body, body = ")) else {
        return Ok(None);
    };
    let body = match rest.trim() {
        "body" => Some(BodyFrame::Imu),
        "tracked-object" => Some(BodyFrame::Other),
        name => {
            name.strip_prefix("camera").and_then(|n| n.parse().ok()).map(|n| BodyFrame::Camera(CameraId(n)))
        }
    };
    match body {
        Some(body) => Ok(Some(body)),
        None => {
            Err(line.error("body, tracked-object or camera0, camera1, …", crate::error::quoted(rest.trim())))
        }
    }
}

/// Collects poses and checks that time increases, so that the error can name the line.
struct Collector {
    body: BodyFrame,
    poses: Vec<StampedPose>,
}

impl Collector {
    fn new() -> Self {
        Self { body: BodyFrame::Other, poses: Vec::new() }
    }

    fn push(&mut self, line: &Line<'_>, time: Timestamp, world_from_body: Se3) -> Result<(), ExportError> {
        if let Some(previous) = self.poses.last()
            && previous.time >= time
        {
            let expected = format!("a time after {}", previous.time);
            return Err(line.error(expected, time));
        }
        self.poses.push(StampedPose { time, world_from_body });
        Ok(())
    }

    fn finish(self, format: &'static str) -> Result<Trajectory, ExportError> {
        Trajectory::new(self.body, self.poses).map_err(|source| ExportError::Trajectory { format, source })
    }
}

/// A pose from text columns: position, then quaternion x y z w.
fn pose_from_columns(line: &Line<'_>, position: [&str; 3], xyzw: [&str; 4]) -> Result<Se3, ExportError> {
    let mut t = Vector3::zeros();
    for (slot, token) in t.iter_mut().zip(position) {
        *slot = line.finite("a finite position, metres", token)?;
    }
    let mut q = [0.0; 4];
    for (slot, token) in q.iter_mut().zip(xyzw) {
        *slot = line.finite("a finite quaternion part", token)?;
    }
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    let rotation = So3::from_quaternion(q[0], q[1], q[2], q[3])
        .filter(|_| (length - 1.0).abs() <= QUATERNION_LENGTH_TOLERANCE)
        .ok_or_else(|| line.error("a unit quaternion", format_args!("one of length {length}")))?;
    Ok(Se3::new(rotation, t))
}
