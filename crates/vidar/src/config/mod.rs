//! Configuration: one plain struct per stage, composed here, in layers; the origin of each value is stored.
//!
//! defaults < preset < file < `VIDAR_SECTION__KEY` < `--set section.key=value` < dedicated flags.

mod explain;
mod layers;
mod presets;

pub use explain::{Explanation, explain, schema};
pub use layers::{Layered, Origin};
pub use presets::{PRESETS, Preset};
pub use vidar_align::keyframe_selection::KeyframeConfig;

use crate::error::Error;
use crate::models::geometry;
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

/// The geometry model, and the number of keyframes per prediction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GeometryConfig {
    /// The model: `auto` (stereo, completed by the map and planes), `stereo` (needs poses, no weights), a network of
    /// `vidar model list` (`da3-small`), `custom` (the weights of `model.dir`, which alone mean it), `recorded:DIR`, predictions of
    /// another program in that folder, or `remote:KEY`, the network of the `vidar worker`s under that key.
    pub source: String,
    /// The network that `auto` bends onto measured depth where nothing is measured: one of `vidar model list`, `recorded:DIR`, or
    /// `none`, which interpolates (as good as `da3-nano`, and it costs nothing). `auto` only; `model.dir` comes first.
    pub fill_network: String,
    /// Keyframes that are predicted together, with stereo at least 2. Larger chunks need more memory and are more consistent.
    pub chunk_keyframes: usize,
    /// Keyframes that a chunk shares with the one before it, for the overlap constraint between them. Networks and recordings only;
    /// smaller than the chunk.
    pub overlap_keyframes: usize,
    /// Keyframes on each side that are used as context only. Stereo only.
    pub context_keyframes: usize,
    /// Largest width of the undistorted images (px); wider images are reduced.
    pub max_width_px: usize,
}

impl Default for GeometryConfig {
    fn default() -> Self {
        Self {
            source: geometry::AUTO.into(),
            fill_network: geometry::NO_NETWORK.into(),
            chunk_keyframes: 16,
            overlap_keyframes: 4,
            context_keyframes: 16,
            max_width_px: 640,
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

/// What goes between a run and the workers of `geometry.source = "remote:KEY"`.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RemoteConfig {
    /// The model that the workers must have: one of `vidar model list`. Empty: any that all of them agree on, whose hash and licence are
    /// recorded. A name that is known must come with its known hash and licence.
    pub model: String,
    /// How images travel: `raw`, the worker sees the same bits, or `jpeg` (quality 92), about a tenth of the bytes and another map.
    #[schemars(with = "String")]
    pub images: vidar_link::geometry::ImageFormat,
    /// How depth and confidence travel: `f32`, the bits of the same model on this machine, or `f16`, half the bytes with a relative error of
    /// at most 5e-4.
    #[schemars(with = "String")]
    pub depth: vidar_link::geometry::DepthFormat,
}

/// How other machines are reached. Nothing here changes a result, and an interrupted run may be resumed with other values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LinkConfig {
    /// Endpoints to connect to, separated by commas, such as `tls/server:7447`. Empty, with `listen` and `config` empty, too: this computer
    /// (`tcp/127.0.0.1:7447`).
    pub connect: String,
    /// Endpoints to listen at, separated by commas, such as `tcp/0.0.0.0:7447`.
    pub listen: String,
    /// A file of Zenoh's settings (JSON5): TLS, certificates, access control.
    pub config: String,
    /// Where `vidar live` publishes poses, keyframes, cloud, mesh and health as ROS 2 messages: domain and namespace, such as `0/vidar`. Empty:
    /// nowhere.
    pub publish: String,
    /// After this time (s) without an answer a worker counts as slow and another one is asked. Several times as long as a chunk takes there.
    pub timeout_secs: f64,
    /// How long (s) a worker is waited for at the start, and while none answers.
    pub patience_secs: f64,
}

impl Default for LinkConfig {
    fn default() -> Self {
        let (connect, listen, config, publish) = Default::default();
        Self { connect, listen, config, publish, timeout_secs: 120.0, patience_secs: 10.0 }
    }
}

impl LinkConfig {
    /// As a session takes it.
    pub fn options(&self) -> vidar_link::LinkOptions {
        let list = |text: &str| {
            text.split(',').map(str::trim).filter(|t| !t.is_empty()).map(str::to_owned).collect()
        };
        vidar_link::LinkOptions {
            listen: list(&self.listen),
            connect: list(&self.connect),
            config: (!self.config.is_empty()).then(|| self.config.clone().into()),
        }
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

impl Config {
    /// Checks every range; the message names the key.
    pub fn validate(&self) -> Result<(), Error> {
        let bad = |reason: String| Err(Error::BadValue { reason });
        let positive = |key: &str, value: f64| match value.is_finite() && value > 0.0 {
            true => Ok(()),
            false => bad(format!("{key} must be finite and positive, found {value}")),
        };
        if self.coupling.place_recognition == PlaceRecognitionConfig::Salad
            && self.coupling.salad_checkpoint.is_empty()
        {
            return bad("coupling.place_recognition = \"salad\" needs coupling.salad_checkpoint".into());
        }
        for (key, value) in [
            ("input.start_secs", self.input.start_secs),
            ("input.end_secs", self.input.end_secs),
            ("output.live_map_wait_secs", self.output.live_map_wait_secs),
        ] {
            if !(value.is_finite() && value >= 0.0) {
                return bad(format!("{key} must be finite and not negative, found {value}"));
            }
        }
        for (key, found) in [
            ("imu_scale_std", self.input.imu_scale_std),
            ("calibration_scale_std", self.input.calibration_scale_std),
        ] {
            if !(0.0..=1.0).contains(&found) {
                return bad(format!("input.{key} must be 0 to 1, found {found}"));
            }
        }
        let budget = &self.budget;
        if !(budget.seconds.is_finite() && budget.seconds >= 0.0) {
            return bad(format!("budget.seconds must be finite and not negative, found {}", budget.seconds));
        }
        if budget.realtime && budget.seconds > 0.0 {
            return bad("budget.realtime and budget.seconds are two limits: leave one of them out".into());
        }
        if !(0.01..=1000.0).contains(&budget.speed) {
            return bad(format!("budget.speed must be 0.01 to 1000, found {}", budget.speed));
        }
        for (key, value) in
            [("timeout_secs", self.link.timeout_secs), ("patience_secs", self.link.patience_secs)]
        {
            if !(0.1..=86_400.0).contains(&value) {
                return bad(format!("link.{key} must be 0.1 to 86400, found {value}"));
            }
        }
        for (key, value) in
            [("input.stride", self.input.stride), ("geometry.chunk_keyframes", self.geometry.chunk_keyframes)]
        {
            if value == 0 {
                return bad(format!("{key} must be at least 1"));
            }
        }
        positive("input.max_pose_gap_secs", self.input.max_pose_gap_secs)?;
        positive("keyframes.min_translation_m", self.keyframes.min_translation_m)?;
        positive("keyframes.unposed_interval_secs", self.keyframes.unposed_interval_secs)?;
        positive("keyframes.min_rotation_deg", self.keyframes.min_rotation_deg)?;
        positive("output.depth_units_per_metre", self.output.depth_units_per_metre)?;
        let (chunk, overlap) = (self.geometry.chunk_keyframes, self.geometry.overlap_keyframes);
        let overlaps = !geometry::source(self).is_ok_and(|s| s.is_by_stereo());
        if !overlaps && chunk < 2 {
            // A chunk of one keyframe has no pair to estimate depth from but those of its context, and is lost.
            return bad("geometry.chunk_keyframes must be at least 2 with stereo, found 1".into());
        }
        if overlaps && overlap >= chunk {
            return bad(format!(
                "geometry.overlap_keyframes must be smaller than geometry.chunk_keyframes ({chunk}), found {overlap}"
            ));
        }
        if !(32..=8192).contains(&self.geometry.max_width_px) {
            return bad(format!(
                "geometry.max_width_px must be 32 to 8192, found {}",
                self.geometry.max_width_px
            ));
        }
        if !self.model.dir.is_empty() && ![geometry::AUTO, geometry::CUSTOM].contains(&&*self.geometry.source)
        {
            let (dir, source) = (&self.model.dir, &self.geometry.source);
            return bad(format!(
                "model.dir names weights ({dir:?}), but geometry.source is {source:?}: leave one of them out"
            ));
        }
        if geometry::chosen(self).is_err() {
            let known = crate::models::names();
            let (source, network) = (&self.geometry.source, &self.geometry.fill_network);
            if source == geometry::AUTO {
                return bad(format!(
                    "geometry.fill_network must be \"none\", \"recorded:DIR\" or one of {known}, found {network:?}"
                ));
            }
            let found = source;
            return bad(format!(
                "geometry.source must be \"auto\", \"stereo\", \"recorded:DIR\", \"remote:KEY\", \"custom\" with model.dir, or one of {known}, found {found:?}"
            ));
        }
        let stage = |result: Result<(), String>| result.map_err(|reason| Error::BadValue { reason });
        stage(self.model.network.validate().map_err(|e| e.to_string()))?;
        stage(self.odometry.validate().map_err(|e| e.to_string()))?;
        stage(self.stereo.validate().map_err(|e| e.to_string()))?;
        stage(self.align.validate().map_err(|e| e.to_string()))?;
        stage(self.fusion.validate().map_err(|e| e.to_string()))?;
        stage(self.eval.trajectory.validate().map_err(|e| e.to_string()))?;
        stage(self.eval.surface.validate().map_err(|e| e.to_string()))
    }
}

#[cfg(test)]
mod tests;
