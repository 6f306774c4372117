//! Reading of recordings: keyframes, undistorted views, sensor depth in a view's pixels.

use nalgebra::Vector3;
use std::error::Error;
use std::path::PathBuf;
use vidar_core::random::SplitMix64;
use vidar_core::remap::{RemapTable, undistorted_view};
use vidar_core::{BodyFrame, ChunkView, Duration, Image, LieGroup, Pinhole, Se3, So3, ViewGeometry};
use vidar_dataset::{CameraFlag, ImageEntry, OpenOptions, Recording};

/// Widest undistorted view, as the program's default is.
const WIDEST_PX: usize = 640;

/// The command line.
pub struct Request {
    path: PathBuf,
    options: OpenOptions,
    pub settings: Vec<String>,
    pub csv: Option<PathBuf>,
    pub stages: bool,
    pub first: usize,
    pub last: usize,
    min_translation_m: f64,
    min_rotation_deg: f64,
    jitter_deg: f64,
    jitter_m: f64,
    lag_ms: f64,
    focal_ratio: f64,
    center_px: f64,
    seed: u64,
}

impl Request {
    pub fn parse(args: &[String]) -> Result<Self, Box<dyn Error>> {
        let (path, flags) = args.split_first().ok_or("usage: evaluate_views RECORDING [FLAG VALUE]...")?;
        let mut request = Self {
            path: path.into(),
            options: OpenOptions::default(),
            settings: Vec::new(),
            csv: None,
            stages: false,
            first: 0,
            last: usize::MAX,
            min_translation_m: 0.08,
            min_rotation_deg: 8.0,
            jitter_deg: 0.0,
            jitter_m: 0.0,
            lag_ms: 0.0,
            focal_ratio: 1.0,
            center_px: 0.0,
            seed: 1,
        };
        for pair in flags.chunks(2) {
            let [flag, value] = pair else { return Err(format!("{} lacks its value", pair[0]).into()) };
            let numbers = || value.split(',').map(str::parse).collect::<Result<Vec<f64>, _>>();
            match flag.as_str() {
                "--camera-model" => request.options.camera_model = Some(value.parse::<CameraFlag>()?.0),
                "--depth-intrinsics" => {
                    let k = numbers()?.try_into().map_err(|_| "four numbers: fx,fy,cx,cy")?;
                    request.options.depth_intrinsics = Some(k);
                }
                "--color-from-depth" => {
                    let t: [f64; 3] = numbers()?.try_into().map_err(|_| "three numbers: x,y,z")?;
                    request.options.color_from_depth = Some(Se3::from_translation(Vector3::from(t)));
                }
                "--set" => request.settings.push(value.clone()),
                "--csv" => request.csv = Some(value.into()),
                "--stages" => request.stages = value == "yes",
                "--first" => request.first = value.parse()?,
                "--last" => request.last = value.parse()?,
                "--min-translation-m" => request.min_translation_m = value.parse()?,
                "--min-rotation-deg" => request.min_rotation_deg = value.parse()?,
                "--jitter-deg" => request.jitter_deg = value.parse()?,
                "--jitter-m" => request.jitter_m = value.parse()?,
                "--lag-ms" => request.lag_ms = value.parse()?,
                "--focal-ratio" => request.focal_ratio = value.parse()?,
                "--center-px" => request.center_px = value.parse()?,
                "--seed" => request.seed = value.parse()?,
                other => return Err(format!("unknown flag {other}").into()),
            }
        }
        Ok(request)
    }

    pub fn name(&self) -> String {
        self.path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned())
    }
}

/// An image with the pose of its camera.
pub struct Keyframe {
    image: ImageEntry,
    world_from_camera: Se3,
    /// The pose at the delayed time.
    lagging: Se3,
}

pub struct ViewSet {
    dataset: Recording,
    pub keyframes: Vec<Keyframe>,
    remap: RemapTable,
}

impl ViewSet {
    pub fn open(request: &Request) -> Result<Self, Box<dyn Error>> {
        let dataset = vidar_dataset::open(&request.path, &request.options)?;
        let camera = dataset.rig.camera(dataset.camera).ok_or("no camera")?;
        let model = &camera.model;
        let width = model.width().min(WIDEST_PX);
        let height = (model.height() as f64 * width as f64 / model.width() as f64).round() as usize;
        let remap = RemapTable::new(model, &undistorted_view(model, width, height)?);
        let truth = dataset.ground_truth.as_ref().ok_or("no ground-truth poses")?;
        let truth = truth.in_frame(BodyFrame::Camera(dataset.camera), &dataset.rig)?;
        let gap = Duration::from_millis(500);
        let lag = Duration::from_secs_f64(1e-3 * request.lag_ms);
        let mut keyframes: Vec<Keyframe> = Vec::new();
        for image in &dataset.images {
            let time = image.time + camera.time_offset;
            let Some(world_from_camera) = truth.interpolate(time, gap) else { continue };
            let moved = keyframes.last().is_none_or(|last| {
                let motion = last.world_from_camera.inverse() * world_from_camera;
                motion.translation.norm() >= request.min_translation_m
                    || motion.rotation.angle_rad().to_degrees() >= request.min_rotation_deg
            });
            if moved {
                let lagging = truth.interpolate(time - lag, gap).unwrap_or(world_from_camera);
                keyframes.push(Keyframe { image: image.clone(), world_from_camera, lagging });
            }
        }
        Ok(Self { dataset, keyframes, remap })
    }

    /// Every keyframe as input of the model, with the requested errors.
    pub fn views(&self, request: &Request) -> Result<Vec<ChunkView>, Box<dyn Error>> {
        let mut random = SplitMix64::new(request.seed);
        let target = self.remap.target();
        let intrinsics = Pinhole::new(
            target.fx * request.focal_ratio,
            target.fy * request.focal_ratio,
            target.cx + request.center_px,
            target.cy - request.center_px,
            target.width,
            target.height,
        )?;
        self.keyframes
            .iter()
            .map(|keyframe| {
                let jitter = Se3::new(
                    So3::exp(&(deviation(&mut random) * request.jitter_deg.to_radians())),
                    deviation(&mut random) * request.jitter_m,
                );
                Ok(ChunkView {
                    frame_id: keyframe.image.frame_id,
                    time: keyframe.image.time,
                    image: self.remap.apply(&self.dataset.load_image(&keyframe.image)?),
                    intrinsics,
                    world_from_camera: Some(keyframe.lagging * jitter),
                })
            })
            .collect()
    }

    /// The sensor's depth registered to a view; NaN without depth.
    pub fn sensor_depth(&self, view: &ViewGeometry) -> Result<Image<f32>, Box<dyn Error>> {
        let sensor = self.dataset.depth_sensor.as_ref().ok_or("no depth camera")?;
        let keyframe =
            self.keyframes.iter().find(|k| k.image.frame_id == view.frame_id).ok_or("no such frame")?;
        // The true camera, also where the model is given another one.
        let k = self.remap.target().resized(view.intrinsics.width, view.intrinsics.height)?;
        let Some(entry) = self.dataset.depth_for(keyframe.image.time) else {
            return Ok(Image::filled(k.width, k.height, f32::NAN));
        };
        let depth = self.dataset.load_depth(entry)?;
        let registered = vidar_eval::register_depth(&depth, &sensor.intrinsics, &sensor.color_from_depth, &k);
        Ok(registered.image().clone())
    }
}

/// Three numbers of mean zero and variance one (sums of twelve uniforms).
fn deviation(random: &mut SplitMix64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| (0..12).map(|_| random.uniform()).sum::<f64>() - 6.0)
}
