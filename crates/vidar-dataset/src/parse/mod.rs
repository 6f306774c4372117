//! Parsers of whole files held in memory. Every one takes bytes of unknown origin and returns a value or an error
//! that names the line; none panics, and none allocates more than a small multiple of the file.

pub(crate) mod columns;
mod jsonl;
pub(crate) mod kitti;
mod lists;
mod matrices;
mod photo;
mod poses;
mod timed;
pub(crate) mod units;
pub(crate) mod yaml;

pub use crate::source::Source;
pub use columns::imu_columns;
pub use jsonl::{JsonCamera, JsonPose, JsonRecording, ReplicaCamera, json_calibration, replica_camera};
pub use kitti::{
    Oxts, ProjectionMatrix, named_numbers, oxts, projection_matrices, rotation_and_translation, times_of_day,
};
pub(crate) use lists::is_image_name;
pub use lists::{
    Association, FrameIntrinsics, ListedFile, ListedTime, associations, file_list, first_column_times,
    frame_intrinsics, time_list,
};
pub use matrices::{intrinsics_matrix, matrix_poses, single_pose};
pub use photo::{PhotoExif, photo_exif};
pub(crate) use poses::is_ambiguous_csv;
pub use poses::{PoseFile, RawPose, euroc_poses, guess_trajectory_format, kitti_poses, tum_poses};
pub use timed::{NumberedPose, accelerometer_list, imu_csv, numbered_poses};
pub(crate) use timed::{TimedRow, imu_file, imu_table};
pub use units::UnitRule;
pub use yaml::{
    CameraCalibration, EurocSensor, ImuCalibration, KalibrCamera, KalibrFile, euroc_sensor_yaml, kalibr_yaml,
};
