//! Trajectory files as [`Trajectory`], with the body whose poses they are.

use crate::checks::{POSE_GAP_FLOOR, find_gaps, put_in_order};
use crate::error::DatasetError;
use crate::options::{TimeUnit, TrajectoryFormat, TrajectoryReadOptions};
use crate::parse::{self, PoseFile, Source, UnitRule};
use crate::source::read_text_file;
use std::path::Path;
use vidar_core::{BodyFrame, CameraId, StampedPose, Timestamp, Trajectory, Warning};

/// Reads a trajectory file (TUM, EuRoC csv, KITTI).
///
/// Poses are strictly increasing in time. Warnings report what was sorted, dropped or assumed.
pub fn read_trajectory(
    path: &Path,
    options: &TrajectoryReadOptions,
) -> Result<(Trajectory, Vec<Warning>), DatasetError> {
    let bytes = read_text_file(path)?;
    trajectory_from(&Source { path, bytes: &bytes }, options)
}

/// The same from bytes in memory.
pub fn trajectory_from(
    source: &Source<'_>,
    options: &TrajectoryReadOptions,
) -> Result<(Trajectory, Vec<Warning>), DatasetError> {
    let mut read = read_poses(source, options)?;
    if read.body_is_assumed {
        read.notes.push(assumed_body(read.trajectory.body(), source.path));
    }
    Ok((read.trajectory, read.notes))
}

/// Reads a file of times, one per line, such as the times of the poses of a KITTI trajectory.
pub fn read_times(path: &Path, unit: Option<TimeUnit>) -> Result<Vec<Timestamp>, DatasetError> {
    let bytes = read_text_file(path)?;
    let rule = unit.map_or(UnitRule::Guess, UnitRule::Given);
    let (times, _) = parse::time_list(&Source { path, bytes: &bytes }, rule)?;
    Ok(times.into_iter().map(|t| t.time).collect())
}

/// The warning when neither the user nor the file states whose poses they are.
pub(crate) fn assumed_body(body: BodyFrame, path: &Path) -> Warning {
    let whose = match body {
        BodyFrame::Imu => "the IMU (body)".to_string(),
        BodyFrame::Camera(id) => format!("camera {id}"),
        BodyFrame::Other => "a tracked object that is neither IMU nor camera".to_string(),
    };
    Warning::new(
        "trajectory-body",
        format!("it is not stated whose poses the trajectory holds; assumed: {whose}"),
    )
    .at(path.display())
    .hint("--trajectory-body imu|camera0 sets the body")
}

/// A trajectory, and whether its body is stated or assumed.
pub(crate) struct ReadPoses {
    pub trajectory: Trajectory,
    pub notes: Vec<Warning>,
    /// Neither the user nor the file states whose poses they are.
    pub body_is_assumed: bool,
}

/// Reads a trajectory without a warning about an assumed body.
pub(crate) fn read_poses(
    source: &Source<'_>,
    options: &TrajectoryReadOptions,
) -> Result<ReadPoses, DatasetError> {
    let format = match options.format.or_else(|| parse::guess_trajectory_format(source)) {
        Some(format) => format,
        None => return Err(not_a_trajectory(source)),
    };
    let file = match format {
        TrajectoryFormat::Tum => {
            parse::tum_poses(source, UnitRule::given_or(options.time_unit, TimeUnit::Seconds))?
        }
        TrajectoryFormat::EurocCsv => {
            parse::euroc_poses(source, UnitRule::given_or(options.time_unit, TimeUnit::Nanoseconds))?
        }
        TrajectoryFormat::Kitti => parse::kitti_poses(source)?,
    };
    let body = body_of(&file, format, options.body);
    let body_is_assumed = options.body.is_none() && file.body.is_none();
    let (trajectory, notes) = finish(source.path, file, body, options.times.as_deref())?;
    Ok(ReadPoses { trajectory, notes, body_is_assumed })
}

fn not_a_trajectory(source: &Source<'_>) -> DatasetError {
    if source.bytes.is_empty() {
        return DatasetError::NoPoses { path: source.path.to_path_buf(), found: "an empty file".into() };
    }
    if parse::is_ambiguous_csv(source) {
        let found = "8 columns with commas and no header: the order of the quaternion is not known";
        let expected =
            "--trajectory-format tum (x y z w) or euroc (w x y z), or a header that names qx and qw";
        return source.malformed(1, found, expected);
    }
    let expected = "rows of TUM (8 columns), EuRoC csv (4, 8, 11 or 17) or KITTI (12)";
    source.malformed(1, "no known trajectory format", expected)
}

/// The body given by the user, else that of the header, else that of the format's own tools.
fn body_of(file: &PoseFile, format: TrajectoryFormat, given: Option<BodyFrame>) -> BodyFrame {
    let by_format = match (file.positions_only, format) {
        (true, _) => BodyFrame::Other,
        (_, TrajectoryFormat::Kitti) => BodyFrame::Camera(CameraId(0)),
        _ => BodyFrame::Imu,
    };
    given.or(file.body).unwrap_or(by_format)
}

/// Assigns times to poses and sorts them.
fn finish(
    path: &Path,
    file: PoseFile,
    body: BodyFrame,
    times: Option<&[Timestamp]>,
) -> Result<(Trajectory, Vec<Warning>), DatasetError> {
    let mut notes = file.notes;
    let untimed = file.poses.iter().any(|p| p.time.is_none());
    if untimed && times.is_none_or(|t| t.len() != file.rows) {
        return Err(DatasetError::TimesMismatch {
            path: path.to_path_buf(),
            poses: file.rows,
            times: times.map_or(0, <[_]>::len),
        });
    }
    let mut poses = Vec::with_capacity(file.poses.len());
    for raw in &file.poses {
        if let Some(time) = raw.time.or_else(|| times?.get(raw.row).copied()) {
            poses.push(StampedPose { time, world_from_body: raw.world_from_body });
        }
    }
    put_in_order(&mut poses, |p| p.time, "poses", path, &mut notes);
    find_gaps(poses.iter().map(|p| p.time), POSE_GAP_FLOOR, "pose-gap", "the trajectory", path, &mut notes);
    if poses.is_empty() {
        let found = format!("{} rows, none of them a finite pose", file.rows);
        return Err(DatasetError::NoPoses { path: path.to_path_buf(), found });
    }
    let trajectory = Trajectory::new(body, poses)
        .map_err(|e| DatasetError::NoPoses { path: path.to_path_buf(), found: e.to_string() })?;
    Ok((trajectory, notes))
}
