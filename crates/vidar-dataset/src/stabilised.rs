//! Video that the camera turned against itself (electronic stabilisation), where the file states how: the IMU's samples are turned with
//! the picture.
//!
//! With `C = start_from_camera` and `I = camera_from_image` of a frame, the picture's orientation is `S = C I`. A body that turns with the picture has the
//! angular rate of `S` and feels `Iᵀ f`. Between frames `S` goes on steadily: it is what a stabiliser makes smooth, while `C` shakes. The camera's place stays the
//! IMU's to some millimetres (a lever arm times the turn), which is left out.

use nalgebra::Vector3;
use vidar_core::{AngularRate, ImuSample, LieGroup, So3, SpecificForce, Timestamp};
use vidar_video::StatedTurns;

/// A picture that is turned by less than this, rad, is not stabilised: a few hundredths of a degree are rounding.
const LEAST_TURN: f64 = 0.003;
/// The frame count and the count of turns may differ by this: a GoPro MAX states one turn more than its clip has frames.
const MOST_LEFT_OVER: usize = 2;
/// Offsets between the clocks of frames and samples that are tried: ± this, in such steps, s.
const SEARCH_SECS: f64 = 0.1;
const STEP_SECS: f64 = 0.002;
/// Frame pairs by which they are compared.
const COMPARED: usize = 1000;
/// Stated turns from frame to frame and those of the gyroscope may differ by this share of the latter, or by this much, rad (RMS): a GoPro MAX's
/// differ by 0.6 % (6e-5 rad), in the wrong order of axes by 4 %, as those of the world instead of the camera's.
const MOST_DIFFERENCE: (f64, f64) = (0.02, 1e-4);

/// Samples that turn with the picture.
pub(crate) struct Turned {
    pub imu: Vec<ImuSample>,
    /// The largest turn of the picture against the camera, rad.
    pub largest_rad: f64,
}

/// The samples as a body has them that turns with the picture; `None` where nothing is turned, and why what is stated is not used.
pub(crate) fn with_the_picture(
    imu: &[ImuSample],
    frames: &[Timestamp],
    stated: &StatedTurns,
) -> Option<Result<Turned, String>> {
    let Some(image) = rotations(&stated.image, [0, 1, 2]) else { return Some(Err(NO_ROTATIONS.into())) };
    let largest_rad = image.iter().map(So3::angle_rad).fold(0.0, f64::max);
    (largest_rad > LEAST_TURN).then(|| {
        let imu = turned(imu, frames, stated)?;
        Ok(Turned { imu, largest_rad })
    })
}

const NO_ROTATIONS: &str = "some of its turns are no rotations";

fn turned(imu: &[ImuSample], frames: &[Timestamp], stated: &StatedTurns) -> Result<Vec<ImuSample>, String> {
    let counts = [frames.len(), stated.camera.len(), stated.image.len()];
    let (least, most) = counts.iter().fold((usize::MAX, 0), |(a, b), n| (a.min(*n), b.max(*n)));
    if least < 3 || most - least > MOST_LEFT_OVER {
        return Err(format!(
            "{} frames, {} turns of the camera, {} of the picture",
            counts[0], counts[1], counts[2]
        ));
    }
    let (Some(origin), Some(path)) = (frames.first(), Path::new(imu, frames[0])) else {
        return Err("too few samples of the gyroscope".into());
    };
    let frame_secs: Vec<f64> = frames[..least].iter().map(|t| (*t - *origin).as_secs_f64()).collect();
    let fit = |order: [usize; 3]| {
        let camera = rotations(&stated.camera[..least], order)?;
        Some((order, path.offset_of(&frame_secs, &camera)))
    };
    let [Some(named), Some(plain)] = [stated.channels, [0, 1, 2]].map(fit) else {
        return Err(NO_ROTATIONS.into());
    };
    let (order, (difference, offset_secs, turning)) = if plain.1.0 < named.1.0 { plain } else { named };
    if difference > (MOST_DIFFERENCE.0 * turning).max(MOST_DIFFERENCE.1) {
        return Err(format!(
            "its turns from frame to frame differ by {:.2}° from those of its gyroscope",
            difference.to_degrees()
        ));
    }
    let Some(image) = rotations(&stated.image[..least], order) else { return Err(NO_ROTATIONS.into()) };
    let secs: Vec<f64> = frame_secs.iter().map(|s| s + offset_secs).collect();
    let picture: Vec<So3> = secs.iter().zip(&image).map(|(s, turn)| path.at(*s) * *turn).collect();
    let (first, last) = (0, least - 1);
    let sample = |s: &ImuSample| {
        let at = (s.time - *origin).as_secs_f64();
        // Before the first frame and after the last one the picture turns with the camera.
        let (picture_from_camera, gyro) = if at < secs[first] || at >= secs[last] {
            let turn = image[if at < secs[first] { first } else { last }].inverse();
            (turn, turn.act(&s.gyro.0))
        } else {
            let k = secs.partition_point(|f| *f <= at) - 1;
            let rate = (picture[k].inverse() * picture[k + 1]).log() / (secs[k + 1] - secs[k]);
            let start_from_picture = picture[k] * So3::exp(&(rate * (at - secs[k])));
            (start_from_picture.inverse() * path.at(at), rate)
        };
        let accel = SpecificForce(picture_from_camera.act(&s.accel.0));
        ImuSample { time: s.time, gyro: AngularRate(gyro), accel }
    };
    Ok(imu.iter().map(sample).collect())
}

/// The rotations of quaternions whose imaginary parts are of the axes `order`; `None` where one is none.
fn rotations(quaternions: &[[f64; 4]], order: [usize; 3]) -> Option<Vec<So3>> {
    let rotation = |[w, parts @ ..]: &[f64; 4]| {
        let mut xyz = [0.0; 3];
        order.iter().zip(parts).for_each(|(axis, part)| xyz[*axis] = *part);
        So3::from_quaternion(xyz[0], xyz[1], xyz[2], *w)
    };
    quaternions.iter().map(rotation).collect()
}

/// The orientation that the gyroscope's rates give.
struct Path {
    secs: Vec<f64>,
    start_from_camera: Vec<So3>,
}

impl Path {
    /// In seconds after `origin`; `None` for less than two samples.
    fn new(imu: &[ImuSample], origin: Timestamp) -> Option<Self> {
        let secs: Vec<f64> = imu.iter().map(|s| (s.time - origin).as_secs_f64()).collect();
        let mut start_from_camera = vec![So3::IDENTITY];
        for (pair, at) in imu.windows(2).zip(secs.windows(2)) {
            let turn = (pair[0].gyro.0 + pair[1].gyro.0) * (0.5 * (at[1] - at[0]));
            start_from_camera.push(*start_from_camera.last()? * So3::exp(&turn));
        }
        (imu.len() > 1).then_some(Self { secs, start_from_camera })
    }

    /// The orientation at a time; beyond the samples the nearest one's.
    fn at(&self, secs: f64) -> So3 {
        let first = self.secs.partition_point(|s| *s <= secs).clamp(1, self.secs.len() - 1) - 1;
        let [from, to] = [self.start_from_camera[first], self.start_from_camera[first + 1]];
        let share = (secs - self.secs[first]) / (self.secs[first + 1] - self.secs[first]).max(1e-9);
        from * So3::exp(&((from.inverse() * to).log() * share.clamp(0.0, 1.0)))
    }

    /// By what the frames' turns from one to the next differ from the gyroscope's (RMS, rad, without the mean, which a bias may
    /// be), the offset of the clocks at which it is least, and the gyroscope's own (RMS).
    fn offset_of(&self, frames: &[f64], camera: &[So3]) -> (f64, f64, f64) {
        let step = frames.len().div_ceil(COMPARED);
        let stated: Vec<(f64, f64, Vector3<f64>)> = (0..frames.len() - 1)
            .step_by(step)
            .map(|k| (frames[k], frames[k + 1], (camera[k].inverse() * camera[k + 1]).log()))
            .collect();
        let n = stated.len() as f64;
        let rms = |all: &[Vector3<f64>]| {
            let mean = all.iter().sum::<Vector3<f64>>() / n;
            (all.iter().map(|v| (v - mean).norm_squared()).sum::<f64>() / n).sqrt()
        };
        let differences = |offset: f64| -> Vec<Vector3<f64>> {
            let felt = |(from, to, _): &(f64, f64, _)| {
                (self.at(from + offset).inverse() * self.at(to + offset)).log()
            };
            stated.iter().map(|pair| pair.2 - felt(pair)).collect()
        };
        let steps = (SEARCH_SECS / STEP_SECS).round() as i32;
        let tried = (-steps..=steps).map(|k| {
            let offset = f64::from(k) * STEP_SECS;
            (rms(&differences(offset)), offset)
        });
        let (difference, offset) = tried.fold((f64::INFINITY, 0.0), |a, b| if b.0 < a.0 { b } else { a });
        let turns: Vec<Vector3<f64>> = stated.iter().map(|pair| pair.2).collect();
        (difference, offset, rms(&turns))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    /// Orientation of the picture, which goes smoothly, and of the camera, which shakes about it.
    fn picture(t: f64) -> So3 {
        So3::exp(&Vector3::new(0.1 * (0.9 * t).sin(), 0.05 * t, 0.3 * (0.7 * t).sin()))
    }

    fn camera(t: f64) -> So3 {
        let shake = [31.0, 23.0, 37.0].map(|w: f64| 0.04 * (w * t).sin());
        picture(t) * So3::exp(&Vector3::from(shake))
    }

    const OFFSET: f64 = 0.014;
    const FRAMES: usize = 150;

    fn recording(order: [usize; 3]) -> (Vec<ImuSample>, Vec<Timestamp>, StatedTurns) {
        let time = |secs: f64| Timestamp::from_nanos((1e9 * (secs + 5.0)).round() as i64);
        let up = Vector3::new(0.0, 0.0, 9.8);
        let imu = (-20..1040)
            .map(|k| {
                let t = f64::from(k) * 0.005;
                let rate = (camera(t - 5e-4).inverse() * camera(t + 5e-4)).log() / 1e-3;
                let felt = camera(t).inverse().act(&up);
                ImuSample { time: time(t), gyro: AngularRate(rate), accel: SpecificForce(felt) }
            })
            .collect();
        let quaternion = |r: So3| {
            let q = UnitQuaternion::from_scaled_axis(r.log());
            [q.w, q.imag()[order[0]], q.imag()[order[1]], q.imag()[order[2]]]
        };
        let stamps = (0..FRAMES).map(|k| k as f64 / 30.0);
        let at = |k: usize| k as f64 / 30.0 + OFFSET;
        let turns = StatedTurns {
            camera: (0..=FRAMES).map(|k| quaternion(camera(0.0).inverse() * camera(at(k)))).collect(),
            image: (0..=FRAMES).map(|k| quaternion(camera(at(k)).inverse() * picture(at(k)))).collect(),
            channels: [0, 2, 1],
        };
        (imu, stamps.map(time).collect(), turns)
    }

    #[test]
    fn samples_turn_with_the_picture() {
        // In the order of the channels, and in that of the axes.
        for order in [[0, 2, 1], [0, 1, 2]] {
            let (imu, frames, stated) = recording(order);
            let turned = with_the_picture(&imu, &frames, &stated).unwrap().unwrap();
            assert!((turned.largest_rad - 0.069).abs() < 0.005, "{}", turned.largest_rad);
            let path = Path::new(&turned.imu, frames[0]).unwrap();
            let (mut worst, mut tilt) = (0.0_f64, 0.0_f64);
            for pair in [(10, 11), (10, 40), (70, 140)] {
                let [from, to] = [pair.0, pair.1].map(|k| k as f64 / 30.0 + OFFSET);
                let felt = path.at(from).inverse() * path.at(to);
                worst = worst.max((felt.inverse() * (picture(from).inverse() * picture(to))).angle_rad());
            }
            // Outside of the frames the picture stays where it is on the camera.
            let norms = |all: &[ImuSample]| (all[3].gyro.0.norm(), all[1030].gyro.0.norm());
            let (before, now) = (norms(&imu), norms(&turned.imu));
            assert!((before.0 - now.0).abs() < 1e-9 && (before.1 - now.1).abs() < 1e-9);
            for sample in &turned.imu[100..900] {
                let at = (sample.time - frames[0]).as_secs_f64();
                tilt = tilt.max((picture(at).act(&sample.accel.0) - Vector3::new(0.0, 0.0, 9.8)).norm());
            }
            assert!(worst < 2e-3, "{order:?}: off by {worst} rad");
            assert!(tilt < 0.05, "{order:?}: gravity off by {tilt} m/s²");
        }
    }

    #[test]
    fn what_the_gyroscope_contradicts_or_does_not_count_up_is_not_used() {
        let (imu, frames, stated) = recording([0, 2, 1]);
        let reason = |stated: &StatedTurns| match with_the_picture(&imu, &frames, stated) {
            Some(Err(reason)) => reason,
            _ => String::new(),
        };
        let other = StatedTurns { camera: vec![[1.0, 0.0, 0.0, 0.0]; FRAMES], ..stated.clone() };
        assert!(reason(&other).contains("from those of its gyroscope"), "{}", reason(&other));
        let fewer = StatedTurns { image: stated.image[..100].to_vec(), ..stated.clone() };
        assert!(reason(&fewer).contains("100 of the picture"), "{}", reason(&fewer));
        let nan = StatedTurns { camera: vec![[f64::NAN; 4]; FRAMES], ..stated.clone() };
        assert!(!reason(&nan).is_empty());
        let mut zero = stated.clone();
        zero.image[70] = [0.0; 4];
        assert!(reason(&zero).contains("no rotations"), "{}", reason(&zero));
        let still = StatedTurns { image: vec![[1.0, 0.0, 0.0, 0.0]; FRAMES], ..stated };
        assert!(with_the_picture(&imu, &frames, &still).is_none());
    }
}
