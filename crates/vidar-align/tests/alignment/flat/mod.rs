//! A simulated furnished room: cameras fly through it, a model predicts chunks in gauges of its own.

use nalgebra::{UnitVector3, Vector2, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};
use std::ops::Range;
use vidar_align::{ChunkObservation, FrameObservation, PosePrior};
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, Confidence, FrameId, GeometryPrediction, Image, LandmarkId, LieGroup, Pinhole, RelativeDepth,
    Se3, Sim3, So3, SparseLandmark, Timestamp, ViewGeometry,
};

pub const WIDTH: usize = 48;
pub const HEIGHT: usize = 32;

pub struct Noise(pub ChaCha8Rng);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub fn uniform(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    pub fn vector(&mut self, std: f64) -> Vector3<f64> {
        Vector3::new(self.normal(), self.normal(), self.normal()) * std
    }

    pub fn gauge(&mut self) -> Sim3 {
        let rotation = So3::exp(&self.vector(1.0));
        Sim3::new(rotation, self.vector(3.0), (0.3 * self.normal()).exp()).unwrap()
    }
}

pub fn camera() -> Pinhole {
    Pinhole::new(38.0, 38.0, 23.5, 15.5, WIDTH, HEIGHT).unwrap()
}

/// Boxes: the room itself (seen from inside) and furniture.
const FURNITURE: [([f64; 3], [f64; 3]); 5] = [
    ([-4.0, -3.0, -0.2], [-2.8, -2.0, 1.1]),
    ([2.6, -3.4, -0.2], [4.2, -2.2, 0.8]),
    ([3.4, 1.4, -0.2], [4.6, 3.0, 2.0]),
    ([-4.8, 1.8, -0.2], [-3.4, 3.6, 0.9]),
    ([-0.6, -0.5, -0.2], [0.6, 0.4, 0.7]),
];
const ROOM: ([f64; 3], [f64; 3]) = ([-5.0, -4.0, -0.2], [5.0, 4.0, 2.8]);

/// Distance along a ray, in units of its direction's length.
fn hit(from: &Vector3<f64>, along: &Vector3<f64>) -> f64 {
    let slab = |(low, high): &([f64; 3], [f64; 3])| {
        let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
        for k in 0..3 {
            let (a, b) = ((low[k] - from[k]) / along[k], (high[k] - from[k]) / along[k]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter, leave)
    };
    let wall = slab(&ROOM).1;
    FURNITURE
        .iter()
        .map(slab)
        .filter(|(enter, leave)| *enter > 1e-6 && enter < leave)
        .fold(wall, |near, (enter, _)| near.min(enter))
}

/// z-depth of the room from a camera, m.
pub fn depth(world_from_camera: &Se3) -> Image<f32> {
    let k = camera();
    Image::from_fn(WIDTH, HEIGHT, |x, y| {
        let ray = world_from_camera.rotation.act(&k.ray(x as f64, y as f64));
        hit(&world_from_camera.translation, &ray) as f32
    })
}

/// A camera at a place, looking along a heading, level up to `tilt`.
pub fn look(place: Vector3<f64>, heading: f64, tilt: f64) -> Se3 {
    let forward = Vector3::new(heading.cos() * tilt.cos(), heading.sin() * tilt.cos(), -tilt.sin());
    let right = forward.cross(&Vector3::z()).normalize();
    let down = forward.cross(&right);
    let matrix = nalgebra::Matrix3::from_columns(&[right, down, forward]);
    Se3::new(So3::from_matrix(&matrix).unwrap(), place)
}

/// `laps` laps around the room, looking outwards and ahead; the same places are seen again in each.
pub fn laps(frames: usize, laps: f64) -> Vec<Se3> {
    (0..frames)
        .map(|i| {
            let a = std::f64::consts::TAU * laps * i as f64 / frames as f64;
            let radius = 1.9 + 0.2 * (3.0 * a).sin();
            let place = Vector3::new(radius * a.cos(), 0.8 * radius * a.sin(), 1.2 + 0.2 * (2.0 * a).sin());
            look(place, a + 0.9 + 0.2 * (2.0 * a).sin(), 0.1 + 0.08 * (3.0 * a).cos())
        })
        .collect()
}

/// How a model errs.
#[derive(Clone, Copy)]
pub struct Model {
    /// Whether each chunk has a gauge of its own.
    pub has_gauge: bool,
    /// Rotation walk per frame, degrees.
    pub turn_deg: f64,
    /// Translation error per frame, share of the step.
    pub step: f64,
    /// Walk of the depth scale per frame, ln.
    pub stretch: f64,
    /// White noise of depth, share.
    pub depth: f64,
}

pub const EXACT: Model = Model { has_gauge: true, turn_deg: 0.0, step: 0.0, stretch: 0.0, depth: 0.0 };
/// What coupling.md calls DA3-like, per keyframe.
pub const REAL: Model = Model { has_gauge: true, turn_deg: 0.12, step: 0.012, stretch: 0.0015, depth: 0.01 };

/// The model's prediction of frames `range` of a flight.
pub fn predict(
    truth: &[Se3],
    range: Range<usize>,
    id: u32,
    model: Model,
    noise: &mut Noise,
) -> GeometryPrediction {
    predict_frames(truth, &range.collect::<Vec<_>>(), id, model, noise)
}

/// The model's prediction of some frames of a flight, in the order given.
pub fn predict_frames(
    truth: &[Se3],
    frames: &[usize],
    id: u32,
    model: Model,
    noise: &mut Noise,
) -> GeometryPrediction {
    let gauge = if model.has_gauge { noise.gauge() } else { Sim3::IDENTITY };
    let chunk_from_world = gauge.inverse();
    let mut bent = truth[frames[0]];
    let mut walk = 0.0_f64;
    let mut views = Vec::new();
    for (n, &i) in frames.iter().enumerate() {
        if n > 0 {
            let step = truth[frames[n - 1]].inverse() * truth[i];
            walk += model.stretch * noise.normal();
            bent = bent
                * Se3::new(
                    step.rotation * So3::exp(&noise.vector(model.turn_deg.to_radians())),
                    step.translation * walk.exp() + noise.vector(model.step * step.translation.norm()),
                );
        }
        let mut image = depth(&truth[i]);
        for z in image.data_mut() {
            let factor = (walk + model.depth * noise.normal()).exp() / gauge.scale;
            *z = (f64::from(*z) * factor) as f32;
        }
        views.push(ViewGeometry {
            frame_id: FrameId(i as u32),
            chunk_from_camera: chunk_from_world.transform_pose(&bent),
            intrinsics: camera(),
            depth: RelativeDepth::new(image),
            confidence: Confidence::new(Image::filled(WIDTH, HEIGHT, 0.8)),
        });
    }
    GeometryPrediction { chunk_id: ChunkId(id), frame: ChunkFrame::ModelNative, views }
}

/// An odometry that drifts: heading and scale walk, the more the larger `drift` (0 = truth).
pub fn drifting(truth: &[Se3], drift: f64, noise: &mut Noise) -> Vec<Se3> {
    let fixed = 0.003 * noise.normal();
    let mut slow = 0.0;
    let mut poses = vec![truth[0]];
    for pair in truth.windows(2) {
        let step = pair[0].inverse() * pair[1];
        slow += noise.normal() / (truth.len() as f64).sqrt();
        let scale = 1.0 + drift * (0.012 * slow + fixed);
        let last = poses[poses.len() - 1];
        // Level: heading about the world's vertical, hardly any tilt.
        let yaw =
            last.rotation.inverse().act(&Vector3::z()) * (drift * 0.06_f64.to_radians() * noise.normal());
        let tilt = noise.vector(drift * 0.005_f64.to_radians());
        poses.push(
            last * Se3::new(
                step.rotation * So3::exp(&(yaw + tilt)),
                step.translation * scale + noise.vector(drift * 0.01 * step.translation.norm()),
            ),
        );
    }
    poses
}

/// Landmarks of a view: pixels with metric inverse depth, `noise` (share) off, some grossly.
pub fn landmarks(
    pose: &Se3,
    frame: usize,
    count: usize,
    share: f64,
    gross: f64,
    noise: &mut Noise,
) -> Vec<SparseLandmark> {
    let image = depth(pose);
    (0..count)
        .map(|k| {
            let (x, y) = (1 + (noise.uniform() * 46.0) as usize, 1 + (noise.uniform() * 30.0) as usize);
            let wild = if noise.uniform() < gross { (0.6 * noise.normal()).exp() } else { 1.0 };
            let z = f64::from(image[(x.min(WIDTH - 1), y.min(HEIGHT - 1))]);
            SparseLandmark {
                id: LandmarkId((frame * 1000 + k) as u32),
                pixel: Vector2::new(x as f64, y as f64),
                inverse_depth: (share * noise.normal()).exp() * wild / z,
                inverse_depth_std: share / z,
            }
        })
        .collect()
}

/// A chunk with pose priors, gravity, time (2 Hz) and, where given, landmarks.
pub fn observe(
    prediction: GeometryPrediction,
    odometry: Option<&[Se3]>,
    landmarks: impl Fn(usize) -> Vec<SparseLandmark>,
) -> ChunkObservation {
    let frames = prediction
        .views
        .iter()
        .map(|v| {
            let i = v.frame_id.index();
            let mut frame = FrameObservation::new(v.frame_id, Timestamp::from_nanos(i as i64 * 500_000_000));
            frame.landmarks = landmarks(i);
            match odometry {
                Some(poses) => {
                    let mut prior = PosePrior::new(poses[i]);
                    let up = poses[i].rotation.inverse().act(&Vector3::z());
                    prior.up_in_camera = Some(UnitVector3::new_normalize(up));
                    frame.with_pose_prior(prior)
                }
                None => frame,
            }
        })
        .collect();
    ChunkObservation { prediction, frames }
}

/// No landmarks.
pub fn none(_: usize) -> Vec<SparseLandmark> {
    Vec::new()
}

/// RMS distance of placed cameras from the truth without any alignment, m.
pub fn absolute_error(placement: &vidar_align::Placement, truth: &[Se3]) -> f64 {
    let squares: f64 = placement
        .views
        .iter()
        .map(|v| (v.world_from_camera.translation - truth[v.frame_id.index()].translation).norm_squared())
        .sum();
    (squares / placement.views.len().max(1) as f64).sqrt()
}
