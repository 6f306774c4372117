//! The next step that an error names.

use super::{Error, is_full, link};

impl Error {
    /// The next step, where one is known.
    pub fn hint(&self) -> Option<String> {
        let text = match self {
            Self::UnknownKey { nearest: Some(nearest), .. } => {
                return Some(format!(
                    "did you mean {nearest:?}? `vidar config explain {nearest}` explains it"
                ));
            }
            Self::Usage { hint, .. } => return Some(hint.clone()),
            Self::NoOverlap { slip: Some(slip), .. } => {
                return Some(format!("{slip}; --time-unit s|ms|us|ns sets the unit of image times"));
            }
            Self::UnknownKey { .. } => "`vidar config show` lists every key",
            Self::BadValue { .. } => "`vidar config explain KEY` shows meaning, unit and range",
            Self::ConfigFile { .. } => "the file is TOML; `vidar config show > my.toml` writes a valid one",
            Self::UnknownPreset { .. } => "`vidar config presets` describes them",
            Self::OutputExists { .. } => {
                "choose another name; --force renames an old folder that is given with -o"
            }
            Self::OtherRun { .. } => {
                "resume with the command in its manifest.json, choose another -o, or use --force instead of --resume to rename \
                 the old folder"
            }
            Self::NoMetricTrajectory { .. } => {
                "give the poses of your own odometry with --trajectory FILE (TUM, EuRoC csv or KITTI, metres)"
            }
            Self::NoOverlap { .. } => {
                "check the trajectory's clock and unit; --time-unit s|ms|us|ns sets the unit of image times"
            }
            Self::TooFewKeyframes { .. } => {
                "lower keyframes.min_translation_m, or give a longer part of the sequence"
            }
            Self::Untrained { .. } => {
                "`vidar model pull da3-small` fetches trained weights (131 MiB, Apache-2.0) for --geometry da3-small; --geometry \
                 stereo needs none; --mode pose-conditioned runs the pipeline without meaningful results"
            }
            Self::Empty { .. } => {
                "check the images in depth/ of the run folder; try --preset quality, or another depth range"
            }
            Self::Geometry(vidar_core::ModelError::OutOfReach(_)) => {
                "start a `vidar worker`, then run the same command with --resume: what is predicted is kept"
            }
            Self::Link(error) => link::hint(error),
            Self::NotABatch { .. } => {
                "`vidar plan RECORDINGS… --store FOLDER` writes a plan and prints its address"
            }
            Self::TaskTooEarly { .. } => {
                "run the stages of a plan in their order: track, predict, map, report"
            }
            other if other.file_system().is_some_and(is_full) => {
                "free space, or choose another disk with -o; finished files are kept"
            }
            other if other.file_system().is_some() => "check that the path exists and may be written",
            Self::NotCalibrated { .. } => {
                "turn the camera about all axes for some seconds while it sees texture, or give --calibration FILE (EuRoC \
                 sensor.yaml, Kalibr camchain)"
            }
            Self::NoCalibration { .. } => {
                "give --calibration FILE (EuRoC sensor.yaml, Kalibr camchain) or --camera-model pinhole:fx,fy,cx,cy"
            }
            Self::ImagesAlone { .. } => {
                "`vidar depth PATH` estimates depth; `vidar run PATH --mode pose-free --geometry da3-nano` makes a map of it in a unit \
                 of its own; a metric map needs --camera-model pinhole:fx,fy,cx,cy (or --calibration FILE) and the poses of another \
                 odometry with --trajectory FILE"
            }
            Self::NoOdometry { .. } => {
                "move sideways at the start; `vidar odometry PATH` writes the state at every image to odometry/health.csv"
            }
            Self::Store(vidar_store::StoreError::BadAddress { .. }) => {
                "--store takes a folder, and s3://bucket/prefix where the program was built with --features s3"
            }
            Self::Store(_) => {
                "check the address, the network and the rights of this worker; what is finished stays, and the same command goes on"
            }
            Self::Camera(_) => {
                "check fx, fy, cx, cy and the distortion in the calibration, or give --camera-model"
            }
            Self::Trajectory(_) => {
                "--trajectory-body imu|camera0 sets the body whose poses they are; --calibration gives the rig"
            }
            Self::Export(_) => "the message names the position in the file; write it again with its program",
            Self::Synth(_) => "`vidar synth --help` lists the options; --world-config takes all settings",
            Self::Odometry(_) => {
                "`vidar inspect PATH` prints camera, extrinsics and IMU as they were read; --calibration corrects them"
            }
            Self::Threshold(_) => "`vidar eval RUN` shows every score",
            Self::Eval(_) => "check that both are of the same recording, body and clock",
            Self::NotARecording { .. } => {
                "docs/guides/recorded-geometry.md describes the format; --stride, --start, geometry.chunk_keyframes and \
                 geometry.overlap_keyframes must be those of the recording"
            }
            Self::NotAMap { .. } => {
                "--map takes the folder that `vidar odometry` or `vidar run` left, of this version; it holds odometry/map.cbor"
            }
            Self::NotARun { .. } => "a run folder contains manifest.json; `vidar run PATH` creates one",
            Self::Recording(error) => return Some(dataset_hint(error).to_owned()),
            Self::Hub(error) => return error.hint(),
            // Every command that opens a network has --model.
            Self::WeightsMissing(error) => {
                return error
                    .hint()
                    .map(|hint| format!("{hint}; --model da3-nano is built in and needs no download"));
            }
            Self::Da3(error) if let Some(advice) = error.device_advice() => advice,
            Self::Da3(_) => {
                "`vidar model list` describes the networks; docs/guides/models.md states what each one needs"
            }
            _ => return None,
        };
        Some(text.to_owned())
    }
}

/// The hint for an error in a recording.
fn dataset_hint(error: &vidar_dataset::DatasetError) -> &'static str {
    use vidar_dataset::DatasetError as D;
    match error {
        D::Io { .. } => "check the path and its read permission",
        D::UnknownLayout { .. } => "--format sets the layout; docs/getting-started.md describes each one",
        D::Malformed { .. } => "repair or remove that line; the file may be truncated or in another format",
        D::MissingCamera { .. } => "choose an available camera with --camera N",
        D::NoImages { .. } => "check --start, --end and --stride, and that the listed images exist",
        D::NoPoses { .. } => "--trajectory-format tum|euroc|kitti sets the format",
        D::BadCamera { .. } | D::UnsupportedCamera { .. } => {
            "correct the calibration, or replace it with --camera-model or --calibration FILE"
        }
        D::NotRigid { .. } => "the matrix maps sensor to body coordinates; its rotation must be orthonormal",
        D::BadImage { .. } => "the image may be truncated; copy the recording again",
        D::WrongImageSize { .. } => {
            "the calibration is for another resolution; give the one for these images"
        }
        D::Topics { .. } => "--topic NAME names a topic of images, depth or IMU; repeatable",
        D::WrongThing { .. } | D::Bag(_) | D::Video(_) => {
            "docs/recordings describes what is read, one page for each source"
        }
        D::TimesMismatch { .. } => "give one time per pose with --timestamps, or the trajectory as TUM",
        D::BadOption { .. } => "`vidar run --help` lists the values of each option",
        _ => "`vidar inspect PATH` shows what was found",
    }
}
