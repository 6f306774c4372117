//! Random streams: one per purpose and index, so that no thread's work changes another's numbers.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What random numbers are drawn for.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    Furniture,
    Imu,
    /// Size of a randomized place.
    Size,
    /// Light of a randomized place.
    Light,
    Exposure,
    /// Sensor noise of one frame.
    Frame(usize),
    /// Points on one face.
    Scan(usize),
    /// Frame, motion and focal length of a chunk's prediction.
    Chunk(u32),
    /// Deformation that belongs to a chunk.
    ChunkField(u32),
    /// Deformation that belongs to a frame.
    FrameField(u32),
    /// Kind of place and flight of a room for clips.
    ClipRoom,
    /// Camera and path of a clip.
    Clip(u32),
    /// Sensor noise of a clip.
    ClipNoise(u32),
    /// Misalignment and lever arm of the camera.
    Mount,
    /// Scale errors of the IMU.
    ImuScale,
    /// Timing of the IMU's samples.
    ImuTiming,
    /// Repeated rows of the IMU.
    ImuRepeats,
    /// Gaps in the IMU's rows.
    ImuGaps,
    /// Noise of an accelerometer with a clock of its own.
    ImuAccel,
    /// Focal length of a partial calibration.
    StatedFocal,
    /// Times, drops and repeats of the frames.
    Schedule,
    /// Errors of the frames' stamps.
    StampErrors,
    /// Hand-held path.
    Handheld,
    /// Surfaces without texture.
    BareSurfaces,
    /// Pixels of a frame in a chunk's prediction.
    Prediction(u32, u32),
}

/// The stream of `purpose` under `seed`.
pub(crate) fn stream(seed: u64, purpose: Purpose) -> ChaCha8Rng {
    let (kind, index) = match purpose {
        Purpose::Furniture => (1, 0),
        Purpose::Imu => (2, 0),
        Purpose::Size => (12, 0),
        Purpose::Light => (13, 0),
        Purpose::Exposure => (3, 0),
        Purpose::Frame(k) => (4, k as u64),
        Purpose::Scan(k) => (5, k as u64),
        Purpose::Chunk(k) => (6, u64::from(k)),
        Purpose::ChunkField(k) => (7, u64::from(k)),
        Purpose::FrameField(k) => (8, u64::from(k)),
        Purpose::ClipRoom => (14, 0),
        Purpose::Clip(k) => (15, u64::from(k)),
        Purpose::ClipNoise(k) => (16, u64::from(k)),
        Purpose::Mount => (17, 0),
        Purpose::ImuScale => (18, 0),
        Purpose::ImuTiming => (19, 0),
        Purpose::StampErrors => (29, 0),
        Purpose::StatedFocal => (20, 0),
        Purpose::Schedule => (21, 0),
        Purpose::Handheld => (22, 0),
        Purpose::BareSurfaces => (23, 0),
        Purpose::ImuRepeats => (24, 0),
        Purpose::ImuGaps => (25, 0),
        Purpose::ImuAccel => (26, 0),
        Purpose::Prediction(_, frame) => (9, u64::from(frame)),
    };
    let seed = match purpose {
        // Two numbers of 32 bits do not fit a stream's 48: the chunk goes into the seed.
        Purpose::Prediction(chunk, _) => seed ^ u64::from(chunk).wrapping_mul(0x9E37_79B9_7F4A_7C15),
        _ => seed,
    };
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream((kind << 48) | index);
    rng
}

/// Standard normal numbers by Box and Muller's transform, two at a time.
pub(crate) struct Gaussian<R> {
    rng: R,
    spare: Option<f64>,
}

impl<R: Rng> Gaussian<R> {
    pub(crate) fn new(rng: R) -> Self {
        Self { rng, spare: None }
    }

    pub(crate) fn next(&mut self) -> f64 {
        if let Some(value) = self.spare.take() {
            return value;
        }
        // 1 − x keeps the logarithm's argument away from zero.
        let radius = (-2.0 * (1.0 - self.rng.random::<f64>()).ln()).sqrt();
        let (sin, cos) = (2.0 * std::f64::consts::PI * self.rng.random::<f64>()).sin_cos();
        self.spare = Some(radius * sin);
        radius * cos
    }

    /// A number in 0…1, 1 excluded.
    pub(crate) fn uniform(&mut self) -> f64 {
        self.rng.random()
    }

    pub(crate) fn vector(&mut self) -> nalgebra::Vector3<f64> {
        nalgebra::Vector3::new(self.next(), self.next(), self.next())
    }
}

/// A number between `low` and `high`, all alike.
pub(crate) fn between(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}
