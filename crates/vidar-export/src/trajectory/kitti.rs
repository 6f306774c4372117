//! KITTI: the upper 3×4 of `world_from_body`, row by row, one pose a line; no times, no comments.

use super::{Collector, body_of_comment, write_header};
use crate::error::{ExportError, write_error};
use crate::text::{Lines, Separator};
use nalgebra::Matrix4;
use std::io::{self, BufWriter, Write};
use vidar_core::trajectory::{BodyFrame, Trajectory};
use vidar_core::{Se3, Timestamp};

const FORMAT: &str = "KITTI trajectory";
const TIMES_FORMAT: &str = "KITTI times";

/// The part missing in a KITTI file: the body of the poses and their times.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KittiTimes {
    /// Body of the poses.
    pub body: BodyFrame,
    /// Time of each line of the KITTI file.
    pub times: Vec<Timestamp>,
}

/// Writes the poses as KITTI text. Write [`write_kitti_times`] as well, otherwise times and body are lost.
pub fn write_kitti(w: impl Write, trajectory: &Trajectory) -> Result<(), ExportError> {
    write_matrices(w, trajectory).map_err(write_error(FORMAT))
}

fn write_matrices(w: impl Write, trajectory: &Trajectory) -> io::Result<()> {
    let mut w = BufWriter::new(w);
    for pose in trajectory.poses() {
        let m = pose.world_from_body.matrix();
        for row in 0..3 {
            for column in 0..4 {
                let end = if (row, column) == (2, 3) { '\n' } else { ' ' };
                // Adding zero turns −0 into 0, which the format's readers print oddly.
                write!(w, "{:.12e}{end}", m[(row, column)] + 0.0)?;
            }
        }
    }
    w.flush()
}

/// Writes the file that accompanies a KITTI file (`.times.txt`): body and note as comments, then seconds, one a line.
pub fn write_kitti_times(
    w: impl Write,
    trajectory: &Trajectory,
    header_note: &str,
) -> Result<(), ExportError> {
    let write = || -> io::Result<()> {
        let mut w = BufWriter::new(w);
        write_header(&mut w, trajectory.body(), header_note)?;
        for pose in trajectory.poses() {
            writeln!(w, "{}", pose.time.to_secs_string())?;
        }
        w.flush()
    };
    write().map_err(write_error(TIMES_FORMAT))
}

/// Reads the times of a KITTI file; also KITTI's own `times.txt` (seconds, exponents allowed).
pub fn read_kitti_times(bytes: &[u8]) -> Result<KittiTimes, ExportError> {
    let mut body = BodyFrame::Other;
    let mut times: Vec<Timestamp> = Vec::new();
    for line in Lines::new(TIMES_FORMAT, bytes)? {
        if let Some(named) = body_of_comment(&line)? {
            body = named;
        }
        if line.is_blank() || line.comment().is_some() {
            continue;
        }
        let [token] = line.columns(Separator::Blank)?;
        let time = Timestamp::parse_secs(token).map_err(|error| line.error("a time in seconds", error))?;
        if let Some(previous) = times.last().filter(|previous| **previous >= time) {
            return Err(line.error(format_args!("a time after {previous}"), time));
        }
        times.push(time);
    }
    Ok(KittiTimes { body, times })
}

/// Reads KITTI poses and joins them with their times, one to one.
///
/// The 3×3 part must be a rotation within 1e-3; the nearest rotation is taken.
pub fn read_kitti(bytes: &[u8], times: &KittiTimes) -> Result<Trajectory, ExportError> {
    let mut collector = Collector::new();
    collector.body = times.body;
    let mut remaining = times.times.iter();
    let mut last_line = 0;
    for line in Lines::new(FORMAT, bytes)? {
        if line.is_blank() {
            continue;
        }
        let Some(time) = remaining.next() else {
            let expected = format!("{} poses, as many as times", times.times.len());
            return Err(line.error(expected, "one more"));
        };
        let tokens = line.columns::<12>(Separator::Blank)?;
        let mut matrix = Matrix4::identity();
        for (i, token) in tokens.into_iter().enumerate() {
            matrix[(i / 4, i % 4)] = line.finite("a finite matrix entry", token)?;
        }
        let world_from_body = Se3::from_matrix(&matrix)
            .ok_or_else(|| line.error("a rotation in the 3x3 part", "another matrix"))?;
        collector.push(&line, *time, world_from_body)?;
        last_line = line.number;
    }
    let missing = remaining.count();
    if missing > 0 {
        return Err(ExportError::malformed(
            FORMAT,
            format!("after line {last_line}"),
            format!("{} poses, as many as times", times.times.len()),
            format!("{missing} too few"),
        ));
    }
    collector.finish(FORMAT)
}
