//! Trajectory files: TUM, EuRoC csv, KITTI.
//!
//! Invalid poses: trackers write a row with NaN, infinity or a zero quaternion while tracking is lost. Such rows are
//! skipped and counted in a warning. A quaternion whose norm differs from one by more than 5 %, or a matrix that is not
//! a rotation, means a wrong file: an error with its line.

use super::matrices::{rigid, row_matrix};
use super::units::{UnitRule, decide_unit, read_time};
use crate::error::DatasetError;
use crate::options::TrajectoryFormat;
use crate::source::{Lines, Row, Source};
use nalgebra::Vector3;
use vidar_core::{BodyFrame, CameraId, Se3, So3, Timestamp, Warning};

/// A pose and its line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawPose {
    /// Line in the file, from 1.
    pub line: usize,
    /// Row among those that are neither empty nor comments, from 0.
    pub row: usize,
    /// When it holds; `None` in KITTI files.
    pub time: Option<Timestamp>,
    /// The pose as written.
    pub world_from_body: Se3,
}

/// What a trajectory file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseFile {
    /// Its poses in the order of the file.
    pub poses: Vec<RawPose>,
    /// Rows in the file, including those that were skipped.
    pub rows: usize,
    /// The body of the poses according to the header (`# world_from_body, body = camera0`).
    pub body: Option<BodyFrame>,
    /// Whether it holds positions only (a prism); then rotations are the identity.
    pub positions_only: bool,
    /// Warnings about the file.
    pub notes: Vec<Warning>,
}

/// A quaternion in a text file of six digits has a length within 1e-5 of one; 5 % is more than rounding.
const QUATERNION_TOLERANCE: f64 = 0.05;

/// Reads TUM rows: `seconds tx ty tz qx qy qz qw`.
pub fn tum_poses(source: &Source<'_>, rule: UnitRule) -> Result<PoseFile, DatasetError> {
    stamped_poses(source, rule, "timestamp tx ty tz qx qy qz qw", |q| [q[0], q[1], q[2], q[3]])
}

/// Reads EuRoC rows: `nanoseconds, px, py, pz, qw, qx, qy, qz, …` (8, 11 or 17 columns) or positions only (4).
pub fn euroc_poses(source: &Source<'_>, rule: UnitRule) -> Result<PoseFile, DatasetError> {
    stamped_poses(source, rule, "timestamp, p x y z, q w x y z", |q| [q[1], q[2], q[3], q[0]])
}

fn stamped_poses(
    source: &Source<'_>,
    rule: UnitRule,
    columns: &str,
    to_xyzw: impl Fn([f64; 4]) -> [f64; 4],
) -> Result<PoseFile, DatasetError> {
    let mut notes = Vec::new();
    let lines = source.lines(&mut notes)?;
    let place = source.path.display().to_string();
    let firsts = lines.rows.iter().map(|r| r.fields().next().unwrap_or(""));
    let unit = decide_unit(rule, firsts, &place, &mut notes);
    // Positions without rotation: the first row decides for the file.
    let positions_only = lines.rows.first().is_some_and(|r| r.fields().count() == 4);
    let wanted = if positions_only { 3 } else { 7 };
    let mut poses = Vec::with_capacity(lines.rows.len());
    let mut lost = LostPoses::default();
    for (index, row) in lines.rows.iter().enumerate() {
        let mut fields = row.fields();
        let time = read_time(source, row, fields.next().unwrap_or(""), unit)?;
        let mut v = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        for (i, number) in v.iter_mut().take(wanted).enumerate() {
            let field = fields.next().ok_or_else(|| {
                let expected = format!("{} columns: {columns}", wanted + 1);
                source.malformed(row.line, format!("{} columns", i + 1), expected)
            })?;
            *number = source.number(row, field, columns)?;
        }
        let q = if positions_only { [0.0, 0.0, 0.0, 1.0] } else { to_xyzw([v[3], v[4], v[5], v[6]]) };
        match pose_from(source, row, [v[0], v[1], v[2]], q)? {
            Some(world_from_body) => {
                poses.push(RawPose { line: row.line, row: index, time: Some(time), world_from_body })
            }
            None => lost.count(row.line),
        }
    }
    lost.warn(&place, &mut notes);
    let body = body_of(&lines);
    Ok(PoseFile { poses, rows: lines.rows.len(), body, positions_only, notes })
}

/// Rows that hold no pose.
#[derive(Default)]
pub(super) struct LostPoses {
    rows: usize,
    first_line: usize,
}

impl LostPoses {
    pub(super) fn count(&mut self, line: usize) {
        if self.rows == 0 {
            self.first_line = line;
        }
        self.rows += 1;
    }

    pub(super) fn warn(&self, place: &str, notes: &mut Vec<Warning>) {
        if self.rows > 0 {
            let message = format!(
                "{} poses contain NaN, infinity or a zero quaternion (tracking lost); skipped",
                self.rows
            );
            notes.push(Warning::new("pose-not-finite", message).at(format!("{place}:{}", self.first_line)));
        }
    }
}

/// The pose of a row; `None` for the rows that lost trackers write.
fn pose_from(
    source: &Source<'_>,
    row: &Row<'_>,
    t: [f64; 3],
    q: [f64; 4],
) -> Result<Option<Se3>, DatasetError> {
    let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    if !t.iter().chain(&q).all(|c| c.is_finite()) || norm < 1e-6 {
        return Ok(None);
    }
    if !((norm - 1.0).abs() <= QUATERNION_TOLERANCE) {
        let found = format!("a quaternion of length {norm:.4}");
        return Err(source.malformed(row.line, found, "a unit quaternion (are the columns in order?)"));
    }
    Ok(So3::from_quaternion(q[0], q[1], q[2], q[3]).map(|r| Se3::new(r, Vector3::from(t))))
}

/// Reads KITTI rows: the upper 3×4 (or whole 4×4) of `world_from_camera`, row by row.
pub fn kitti_poses(source: &Source<'_>) -> Result<PoseFile, DatasetError> {
    let mut notes = Vec::new();
    let lines = source.lines(&mut notes)?;
    let mut poses = Vec::with_capacity(lines.rows.len());
    let mut lost = LostPoses::default();
    for (index, row) in lines.rows.iter().enumerate() {
        let m = row_matrix(source, row)?;
        if m.iter().all(|v| v.is_finite()) {
            let world_from_body = rigid(source, row.line, &m)?;
            poses.push(RawPose { line: row.line, row: index, time: None, world_from_body });
        } else {
            lost.count(row.line);
        }
    }
    lost.warn(&source.path.display().to_string(), &mut notes);
    let body = body_of(&lines);
    Ok(PoseFile { poses, rows: lines.rows.len(), body, positions_only: false, notes })
}

/// The body of the poses according to the header.
fn body_of(lines: &Lines<'_>) -> Option<BodyFrame> {
    lines.comments.iter().find_map(|comment| {
        let (_, after) = comment.split_once("body =")?;
        let name = after.trim().split([' ', ',', ';']).next()?;
        match name {
            "body" | "imu" => Some(BodyFrame::Imu),
            "tracked-object" => Some(BodyFrame::Other),
            camera => camera.strip_prefix("camera")?.parse().ok().map(|id| BodyFrame::Camera(CameraId(id))),
        }
    })
}

/// The format of a trajectory file, by its first row: 12 or 16 columns are KITTI; a comma or a nanosecond stamp is
/// EuRoC csv, unless the header puts `qw` last; the rest is TUM. Rows of 8 columns with commas, no header and no nanosecond
/// stamp may be either, with other orders of the quaternion: `None`.
pub fn guess_trajectory_format(source: &Source<'_>) -> Option<TrajectoryFormat> {
    let first = FirstRow::of(source)?;
    match first.w_is_last {
        _ if first.columns == 12 || first.columns == 16 => Some(TrajectoryFormat::Kitti),
        _ if first.is_ambiguous() => None,
        Some(true) => Some(TrajectoryFormat::Tum),
        _ if first.is_nanoseconds || first.is_csv => Some(TrajectoryFormat::EurocCsv),
        _ => (first.columns >= 8).then_some(TrajectoryFormat::Tum),
    }
}

/// Whether the file is a csv whose order of the quaternion nothing tells.
pub(crate) fn is_ambiguous_csv(source: &Source<'_>) -> bool {
    FirstRow::of(source).is_some_and(|first| first.is_ambiguous())
}

/// What the first row and the header tell of a format.
struct FirstRow {
    columns: usize,
    is_csv: bool,
    is_nanoseconds: bool,
    /// Order of the quaternion in the header, if it names it.
    w_is_last: Option<bool>,
}

impl FirstRow {
    fn of(source: &Source<'_>) -> Option<Self> {
        // Only the head is looked at; a cut last line does not matter.
        let head = Source { path: source.path, bytes: source.bytes.get(..64 << 10).unwrap_or(source.bytes) };
        let head = match head.bytes.iter().rposition(|&b| b == b'\n') {
            Some(end) => Source { path: head.path, bytes: head.bytes.get(..end)? },
            None => head,
        };
        let lines = head.lines(&mut Vec::new()).ok()?;
        let first = lines.rows.first()?;
        let header = lines.comments.join(" ").to_ascii_lowercase();
        let w_is_last =
            match (header.find("qw").or(header.find("q_w")), header.find("qx").or(header.find("q_x"))) {
                (Some(w), Some(x)) => Some(w > x),
                _ => None,
            };
        let is_nanoseconds = first.fields().next()?.parse::<f64>().is_ok_and(|t| t >= 1e17);
        let is_csv = first.text.contains([',', ';']);
        Some(Self { columns: first.fields().count(), is_csv, is_nanoseconds, w_is_last })
    }

    /// EuRoC's files of 11 and 17 columns are told by their columns, those of 4 have no quaternion.
    fn is_ambiguous(&self) -> bool {
        self.is_csv && !self.is_nanoseconds && self.columns == 8 && self.w_is_last.is_none()
    }
}
