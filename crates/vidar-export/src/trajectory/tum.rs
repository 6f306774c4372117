//! TUM: `timestamp tx ty tz qx qy qz qw`, seconds and metres, one pose a line.

use super::{Collector, body_of_comment, pose_from_columns, write_header};
use crate::error::{ExportError, write_error};
use crate::text::{Lines, Separator};
use std::io::{self, BufWriter, Write};
use vidar_core::Timestamp;
use vidar_core::trajectory::Trajectory;

const FORMAT: &str = "TUM trajectory";

/// Writes a trajectory as TUM text with nine decimals; `header_note` becomes comment lines.
pub fn write_tum(w: impl Write, trajectory: &Trajectory, header_note: &str) -> Result<(), ExportError> {
    write_lines(w, trajectory, header_note).map_err(write_error(FORMAT))
}

fn write_lines(w: impl Write, trajectory: &Trajectory, header_note: &str) -> io::Result<()> {
    let mut w = BufWriter::new(w);
    write_header(&mut w, trajectory.body(), header_note)?;
    writeln!(w, "# timestamp tx ty tz qx qy qz qw")?;
    for pose in trajectory.poses() {
        let t = pose.world_from_body.translation;
        let [x, y, z, qw] = pose.world_from_body.rotation.quaternion_xyzw();
        let time = pose.time.to_secs_string();
        writeln!(w, "{time} {:.9} {:.9} {:.9} {x:.9} {y:.9} {z:.9} {qw:.9}", t.x, t.y, t.z)?;
    }
    w.flush()
}

/// Reads a TUM trajectory: exactly eight columns, times increasing, quaternions of unit length (within 1 %).
///
/// The body is the one named by the header of [`write_tum`], else [`vidar_core::trajectory::BodyFrame::Other`].
pub fn read_tum(bytes: &[u8]) -> Result<Trajectory, ExportError> {
    let mut collector = Collector::new();
    for line in Lines::new(FORMAT, bytes)? {
        if let Some(body) = body_of_comment(&line)? {
            collector.body = body;
        }
        if line.is_blank() || line.comment().is_some() {
            continue;
        }
        let [time, tx, ty, tz, qx, qy, qz, qw] = line.columns(Separator::Blank)?;
        let time = Timestamp::parse_secs(time).map_err(|error| line.error("a time in seconds", error))?;
        collector.push(&line, time, pose_from_columns(&line, [tx, ty, tz], [qx, qy, qz, qw])?)?;
    }
    collector.finish(FORMAT)
}
