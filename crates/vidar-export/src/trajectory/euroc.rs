//! EuRoC csv: `timestamp [ns], p_x, p_y, p_z [m], q_w, q_x, q_y, q_z`, the layout of `state_groundtruth_estimate0`.

use super::{Collector, body_of_comment, pose_from_columns, write_header};
use crate::error::{ExportError, write_error};
use crate::text::{Lines, Separator};
use std::io::{self, BufWriter, Write};
use vidar_core::Timestamp;
use vidar_core::trajectory::Trajectory;

const FORMAT: &str = "EuRoC trajectory csv";

/// Writes a trajectory as EuRoC csv, integer nanoseconds, w first; `header_note` becomes comment lines.
///
/// Only time, position and rotation are written (eight columns): velocities and biases are not part of a
/// [`Trajectory`], and zeros in their place would be read as measurements.
pub fn write_euroc_csv(w: impl Write, trajectory: &Trajectory, header_note: &str) -> Result<(), ExportError> {
    write_lines(w, trajectory, header_note).map_err(write_error(FORMAT))
}

fn write_lines(w: impl Write, trajectory: &Trajectory, header_note: &str) -> io::Result<()> {
    let mut w = BufWriter::new(w);
    write_header(&mut w, trajectory.body(), header_note)?;
    writeln!(
        w,
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    )?;
    for pose in trajectory.poses() {
        let t = pose.world_from_body.translation;
        let [x, y, z, qw] = pose.world_from_body.rotation.quaternion_xyzw();
        let time = pose.time.nanos();
        writeln!(w, "{time},{:.9},{:.9},{:.9},{qw:.9},{x:.9},{y:.9},{z:.9}", t.x, t.y, t.z)?;
    }
    w.flush()
}

/// Reads an EuRoC csv of eight columns, or the seventeen of a ground-truth file (velocity and biases are checked
/// to be numbers and ignored).
///
/// The body is the one named by the header of [`write_euroc_csv`], else
/// [`vidar_core::trajectory::BodyFrame::Other`].
pub fn read_euroc_csv(bytes: &[u8]) -> Result<Trajectory, ExportError> {
    let mut collector = Collector::new();
    for line in Lines::new(FORMAT, bytes)? {
        if let Some(body) = body_of_comment(&line)? {
            collector.body = body;
        }
        if line.is_blank() || line.comment().is_some() {
            continue;
        }
        let [time, tx, ty, tz, qw, qx, qy, qz] = if line.text.split(',').count() == 17 {
            let all = line.columns::<17>(Separator::Comma)?;
            for token in &all[8..] {
                line.number::<f64>("a number", token)?;
            }
            [all[0], all[1], all[2], all[3], all[4], all[5], all[6], all[7]]
        } else {
            line.columns(Separator::Comma)?
        };
        let time = line.number::<i64>("a time in integer nanoseconds", time)?;
        let pose = pose_from_columns(&line, [tx, ty, tz], [qx, qy, qz, qw])?;
        collector.push(&line, Timestamp::from_nanos(time), pose)?;
    }
    collector.finish(FORMAT)
}
