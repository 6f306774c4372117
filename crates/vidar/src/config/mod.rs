//! Configuration: one plain struct per stage, composed here, in layers; the origin of each value is stored.
//!
//! defaults < preset < file < `VIDAR_SECTION__KEY` < `--set section.key=value` < dedicated flags.

mod explain;
mod geometry;
mod layers;
mod link;
mod presets;
mod validate;

pub use explain::{Explanation, explain, schema};
pub use geometry::GeometryConfig;
pub use layers::{Layered, Origin};
pub use link::{LinkConfig, RemoteConfig};
pub use presets::{PRESETS, Preset};
pub use vidar_align::keyframe_selection::KeyframeConfig;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Selection of the input.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct InputConfig {
    /// Number of the camera to use (`cam0` is 0).
    pub camera: u32,
    /// Start, seconds after the first image.
    pub start_secs: f64,
    /// End, seconds after the first image; 0 means to the end.
    pub end_secs: f64,
    /// Use every n-th image, 1 or more. Raise it for high frame rates.
    pub stride: usize,
    /// Where metric poses come from: `auto` (an external trajectory, else the odometry of camera and IMU, else ground truth),
    /// `external`, `odometry`, `ground-truth`.
    pub poses: PoseSource,
    /// Longest gap (s) between two poses that is interpolated. Raise it for keyframe-only trajectories.
    pub max_pose_gap_secs: f64,
    /// Standard deviation of ln(scale) for what no estimate sees: the gain of the accelerometer and the lever arm of the camera.
    /// Part of the stated scale wherever the odometry is its source. 0.01: a consumer IMU (data sheets say 1 % typically) and a
    /// lever arm known to 1 or 2 cm; 0.003: a factory-calibrated IMU on a calibrated rig; 0: exact, as in simulation.
    pub imu_scale_std: f64,
    /// Standard deviation of ln(scale) for a calibration that nothing has checked: part of the stated scale where the trajectory is the
    /// live one, which takes lever arm, focal length, clock and the gyroscope's gain as given. 0.07: a lever arm off by 30 cm, or a focal
    /// length or gain by 10 %, makes the scale of a flight wrong by 8 to 20 %. The adjustment (`odometry.adjust`) estimates or contradicts
    /// them, so nothing is added there; 0.005: a calibration made with a target on this rig.
    pub calibration_scale_std: f64,
    /// Folder of an earlier `vidar odometry` or `vidar run` of the same place, or its `odometry/map.cbor`: the odometry looks for the place in
    /// it, and its poses are then in the world of that recording. Empty: none.
    pub map: String,
    /// Folder of masks, black where an image is not to be used (people who move, the camera's carrier), called as the images are:
    /// `NAME.EXT.png` as COLMAP has them, or `NAME.png`. Stereo, alignment and map leave these pixels out; the odometry does not read
    /// them. Empty: none.
    pub masks: String,
}

/// Where metric poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PoseSource {
    /// The external trajectory if given, else the odometry where there is an IMU, else ground truth.
    Auto,
    /// The external trajectory only.
    External,
    /// Ground truth only.
    GroundTruth,
    /// The odometry of camera and IMU, on every image.
    Odometry,
}

impl Default for InputConfig {
    fn default() -> Self {
        Self {
            camera: 0,
            start_secs: 0.0,
            end_secs: 0.0,
            stride: 1,
            poses: PoseSource::Auto,
            max_pose_gap_secs: 0.5,
            imu_scale_std: 0.01,
            calibration_scale_std: 0.07,
            map: String::new(),
            masks: String::new(),
        }
    }
}

/// Coupling of depth and metric poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CouplingConfig {
    /// `coupled` estimates poses and chunks together; `pose-conditioned` and `hybrid` are the paper's; `ground-truth` is
    /// pose-conditioned on true poses, an upper bound; `pose-free` and `da3-streaming` use no metric poses, so their maps are not metric.
    pub mode: vidar_align::CouplingMode,
    /// Predict both ends of a loop together, as DA3-Streaming does: one more prediction per loop. Otherwise the stored
    /// predictions of the two chunks are compared.
    pub loop_chunks: bool,
    /// Landmarks that give chunks their scale and correct their depth: `odometry`, `stereo` (reliable stereo points of the
    /// same images, where network and stereo differ by more than the stereo error; a tenth of a second of CPU time per
    /// keyframe), `both`, `none`, or `auto`: both in `coupled`, none in the paper's couplings.
    pub landmarks: LandmarkSources,
    /// Look for loops and close them. Couplings that place each chunk by its poses alone have none.
    pub loops: bool,
    /// Place recognition descriptor: `salad` (needs `coupling.salad_checkpoint`), `model` (tokens of the geometry network, at
    /// no extra cost), `image` (recognises the same view, not the same place from another side), or `auto`, the first of
    /// these that is available.
    pub place_recognition: PlaceRecognitionConfig,
    /// SALAD's published checkpoint, converted by `tools/salad_to_safetensors.py`. Runs one more network of 350 MB per
    /// keyframe; it recognises places from other viewpoints.
    pub salad_checkpoint: String,
}

impl Default for CouplingConfig {
    fn default() -> Self {
        Self {
            mode: vidar_align::CouplingMode::default(),
            landmarks: LandmarkSources::Auto,
            loops: true,
            loop_chunks: false,
            place_recognition: PlaceRecognitionConfig::Auto,
            salad_checkpoint: String::new(),
        }
    }
}

impl CouplingConfig {
    /// Whether a source of landmarks takes part.
    pub fn uses_landmarks(&self, source: LandmarkSources) -> bool {
        let chosen = match (self.landmarks, self.mode) {
            (LandmarkSources::Auto, vidar_align::CouplingMode::Coupled) => LandmarkSources::Both,
            (LandmarkSources::Auto, _) => LandmarkSources::None,
            (chosen, _) => chosen,
        };
        chosen == source || chosen == LandmarkSources::Both
    }
}

/// Where landmarks come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LandmarkSources {
    /// Both in `coupled`, none in the paper's couplings.
    #[default]
    Auto,
    /// No landmarks.
    None,
    /// Points that the odometry tracks.
    Odometry,
    /// The surest points of multi-view stereo.
    Stereo,
    /// Odometry and stereo.
    Both,
}

/// Place recognition descriptor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PlaceRecognitionConfig {
    /// The best one available.
    #[default]
    Auto,
    /// SALAD's descriptors.
    Salad,
    /// Averaged tokens of the geometry network.
    Model,
    /// Brightness and gradients of the image.
    Image,
}

/// The network, if `geometry.source` names one.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ModelConfig {
    /// Folder with `model.safetensors` and `config.json` of custom weights. They are the source of geometry, unless
    /// `geometry.source` is set to `auto`, which then fills with them.
    pub dir: String,
    /// Precision of the backbone. `auto` is bf16 if the processor supports it, else f32 (recorded in the manifest);
    /// `f32` is the reference.
    pub precision: vidar_da3::Precision,
    /// Device that runs the network: `cpu`, `gpu` (the best hardware device), `gpu:N` (number N of `vidar doctor`), or `auto`
    /// (a graphics processor if there is one). All but `cpu` need a program built with `--features gpu`.
    #[schemars(with = "String")]
    pub device: vidar_da3::Device,
    /// How the network is used.
    pub network: vidar_da3::Da3ModelConfig,
}

/// Evaluation of the result.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EvalConfig {
    /// Evaluate the result if there is a reference.
    pub mode: EvalMode,
    /// Trajectory metrics.
    pub trajectory: vidar_eval::TrajectoryEvalConfig,
    /// Surface metrics.
    pub surface: vidar_eval::SurfaceEvalConfig,
}

/// Whether the result is evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum EvalMode {
    /// If there is a reference.
    #[default]
    Auto,
    /// Never.
    Off,
}

/// What is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OutputConfig {
    /// Write the depth of every keyframe as 16-bit PNG.
    pub depth_png: bool,
    /// Units of the depth PNG per metre: 1000 is millimetres, 5000 is TUM's.
    pub depth_units_per_metre: f64,
    /// Write the undistorted keyframe images; COLMAP and nerfstudio exports need them.
    pub images: bool,
    /// Write the mesh as GLB in addition to PLY.
    pub mesh_glb: bool,
    /// Draw pictures and the HTML report.
    pub report: bool,
    /// Keep the predictions of every chunk in `chunks/`, for `--geometry recorded:RUN/chunks`. Otherwise they are removed at
    /// the end of the run.
    pub keep_chunks: bool,
    /// Write `map/so_far.ply` after every chunk, with provisional placements, for viewing. Costs one more fusion; the final
    /// map is the same.
    pub live_map: bool,
    /// `vidar live`: longest that a keyframe waits until that file shows it (s of the recording). One that still waits for the keyframes
    /// after it is predicted without them, where there is time, and once more with them. 0: as long as it takes. Stereo only.
    pub live_map_wait_secs: f64,
}

impl Default for OutputConfig {
    fn default() -> Self {
        Self {
            depth_png: true,
            depth_units_per_metre: 1000.0,
            images: true,
            mesh_glb: true,
            report: true,
            keep_chunks: false,
            live_map: false,
            live_map_wait_secs: 0.0,
        }
    }
}

/// Resource limits.
#[derive(Clone, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LimitsConfig {
    /// Memory limit (bytes) for planning; 0 means the sum of the parts. The map gets the part that network and chunk leave: a
    /// larger map is truncated, with a warning. Set it if other programs need memory.
    pub memory_bytes: u64,
}

/// How long a run may take. What it may cost is planned from poses and keyframes by a fixed model of the cost, never measured, so that the
/// same command gives the same bits on every machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct BudgetConfig {
    /// Wall time that the run should take at most, s; 0 means no limit. Stereo then takes smaller images, fewer neighbours and fewer
    /// keyframes, as far as needed. `auto` without a network and `stereo` only.
    pub seconds: f64,
    /// The limit is the recording's own duration.
    pub realtime: bool,
    /// How many times as fast as two quiet cores of the machine of BENCHMARK.md this one is, 0.01 to 1000. A run with a limit says which
    /// value would have been right.
    pub speed: f64,
}

impl Default for BudgetConfig {
    fn default() -> Self {
        Self { seconds: 0.0, realtime: false, speed: 1.0 }
    }
}

impl BudgetConfig {
    /// Whether there is a limit.
    pub fn is_limited(&self) -> bool {
        self.realtime || self.seconds > 0.0
    }
}

/// The whole configuration.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Selection of the input.
    pub input: InputConfig,
    /// Choice of keyframes.
    pub keyframes: KeyframeConfig,
    /// Which model sees them.
    pub geometry: GeometryConfig,
    /// The network, where one is used.
    pub model: ModelConfig,
    /// Visual-inertial odometry.
    pub odometry: vidar_odometry::OdometryConfig,
    /// Multi-view stereo.
    pub stereo: vidar_stereo::StereoConfig,
    /// Coupling of depth and metric poses.
    pub coupling: CouplingConfig,
    /// Placement of chunks.
    pub align: vidar_align::AlignerConfig,
    /// Fusion into one surface.
    pub fusion: vidar_fusion::FusionConfig,
    /// Evaluation.
    pub eval: EvalConfig,
    /// What is written.
    pub output: OutputConfig,
    /// Resource limits.
    pub limits: LimitsConfig,
    /// How long a run may take.
    pub budget: BudgetConfig,
    /// What goes between a run and geometry workers.
    pub remote: RemoteConfig,
    /// How other machines are reached.
    pub link: LinkConfig,
}

#[cfg(test)]
mod tests;
