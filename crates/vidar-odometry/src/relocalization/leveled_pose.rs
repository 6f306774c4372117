//! Pose of a camera of known roll and pitch from points of a map: turn about the vertical and place, four unknowns.

use nalgebra::{Matrix4, Vector2, Vector3, Vector4};
use vidar_core::{LieGroup, So3};
use vidar_solve::pcg64::Pcg64;

/// Samples that are tried: with one match in eight right, both of a pair are right once in 64.
const SAMPLES: usize = 600;

/// Rays that agree lie within this many standard deviations.
const INLIER_SIGMAS: f64 = 3.0;

/// Steps of the refinement on all that agree, and times that these are chosen anew.
const STEPS: usize = 5;
const ROUNDS: usize = 3;

/// A unit ray in a levelled frame (z up), and the point of the map that it may show.
#[derive(Clone, Copy, Debug)]
pub(super) struct Correspondence {
    pub ray: Vector3<f64>,
    pub point: Vector3<f64>,
}

/// A levelled camera in the map.
#[derive(Clone, Copy, Debug)]
pub(super) struct LeveledPose {
    /// A turn about the vertical.
    pub map_from_leveled: So3,
    /// Where the camera is, m.
    pub position: Vector3<f64>,
}

/// A pose, and which correspondences agree with it.
#[derive(Clone, Debug)]
pub(super) struct Found {
    pub pose: LeveledPose,
    pub inliers: Vec<usize>,
}

/// The pose that most correspondences agree with; `None` where fewer than four do.
pub(super) fn estimate(pairs: &[Correspondence], sigma_rad: f64) -> Option<Found> {
    if pairs.len() < 4 {
        return None;
    }
    let mut random = Pcg64::seed(0);
    let mut best: Option<Found> = None;
    for _ in 0..SAMPLES {
        let sample = random.choose(pairs.len(), 2);
        for pose in from_two(&pairs[sample[0]], &pairs[sample[1]]) {
            let inliers = agreeing(&pose, pairs, sigma_rad);
            if best.as_ref().is_none_or(|b| inliers.len() > b.inliers.len()) {
                best = Some(Found { pose, inliers });
            }
        }
    }
    let mut found = best?;
    for _ in 0..ROUNDS {
        let refined = refined(&found, pairs)?;
        let inliers = agreeing(&refined, pairs, sigma_rad);
        if inliers.len() < found.inliers.len() {
            break;
        }
        found = Found { pose: refined, inliers };
    }
    (found.inliers.len() >= 4).then_some(found)
}

/// The up to two poses from which two points are seen along two rays.
///
/// With distances a and b along the rays, `X₁ − X₂ = R(a·r₁ − b·r₂)`. The vertical component does not depend on R and is linear in a and b;
/// the length of the horizontal part does not either, which leaves a quadratic equation along that line.
fn from_two(one: &Correspondence, two: &Correspondence) -> Vec<LeveledPose> {
    let apart = one.point - two.point;
    let (r, q) = (one.ray, two.ray);
    let square = r.z * r.z + q.z * q.z;
    if square < 1e-6 {
        return Vec::new();
    }
    // (a, b) = at + k · along.
    let at = Vector2::new(r.z, -q.z) * (apart.z / square);
    let along = Vector2::new(q.z, r.z);
    let across = |d: &Vector2<f64>| d.x * r.xy() - d.y * q.xy();
    let (base, slope) = (across(&at), across(&along));
    let (a, b, c) = (slope.norm_squared(), base.dot(&slope), base.norm_squared() - apart.xy().norm_squared());
    let discriminant = b * b - a * c;
    if a < 1e-12 || !(discriminant >= 0.0) {
        return Vec::new();
    }
    let root = discriminant.sqrt();
    let pose = |k: f64| {
        let distances = at + k * along;
        let seen = base + k * slope;
        if distances.min() <= 0.0 || seen.norm() < 1e-9 {
            return None;
        }
        let yaw = apart.y.atan2(apart.x) - seen.y.atan2(seen.x);
        let map_from_leveled = So3::exp(&(Vector3::z() * yaw));
        let position = one.point - map_from_leveled.act(&(r * distances.x));
        Some(LeveledPose { map_from_leveled, position })
    };
    [(-b - root) / a, (-b + root) / a].into_iter().filter_map(pose).collect()
}

/// The correspondences whose ray is where the pose says.
fn agreeing(pose: &LeveledPose, pairs: &[Correspondence], sigma_rad: f64) -> Vec<usize> {
    let limit = INLIER_SIGMAS * sigma_rad;
    let leveled_from_map = pose.map_from_leveled.inverse();
    let is_near = |pair: &Correspondence| {
        let seen = leveled_from_map.act(&(pair.point - pose.position));
        let length = seen.norm();
        length > 1e-6 && (seen / length - pair.ray).norm() < limit
    };
    (0..pairs.len()).filter(|k| is_near(&pairs[*k])).collect()
}

/// Least squares of the angles between rays and points (Gauss-Newton).
fn refined(found: &Found, pairs: &[Correspondence]) -> Option<LeveledPose> {
    let mut pose = found.pose;
    for _ in 0..STEPS {
        let (mut square, mut right) = (Matrix4::zeros(), Vector4::zeros());
        let leveled_from_map = pose.map_from_leveled.inverse();
        for k in &found.inliers {
            let Correspondence { ray, point } = pairs[*k];
            let seen = leveled_from_map.act(&(point - pose.position));
            let length = seen.norm();
            let direction = seen / length;
            let left = ray - direction;
            // Of the direction by the turn and by the place.
            let tangential = |d: Vector3<f64>| (d - direction * direction.dot(&d)) / length;
            let by_yaw = tangential(seen.cross(&Vector3::z()));
            let by_place = |axis: Vector3<f64>| tangential(-leveled_from_map.act(&axis));
            let columns = [by_yaw, by_place(Vector3::x()), by_place(Vector3::y()), by_place(Vector3::z())];
            for i in 0..4 {
                right[i] += columns[i].dot(&left);
                for j in 0..4 {
                    square[(i, j)] += columns[i].dot(&columns[j]);
                }
            }
        }
        let step = square.cholesky()?.solve(&right);
        pose.map_from_leveled = pose.map_from_leveled * So3::exp(&(Vector3::z() * step[0]));
        pose.position += step.fixed_rows::<3>(1);
        if step.norm() < 1e-9 {
            break;
        }
    }
    pose.position.iter().all(|v| v.is_finite()).then_some(pose)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(count: usize, wrong: usize) -> (LeveledPose, Vec<Correspondence>) {
        let mut random = Pcg64::seed(3);
        let mut uniform =
            |scale: f64| scale * ((random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64 - 0.5);
        let truth = LeveledPose {
            map_from_leveled: So3::exp(&(Vector3::z() * 2.1)),
            position: Vector3::new(1.0, -2.0, 0.7),
        };
        let pairs = (0..count)
            .map(|k| {
                let point = Vector3::new(uniform(6.0), uniform(6.0), uniform(3.0));
                let seen = truth.map_from_leveled.inverse().act(&(point - truth.position));
                let noise = Vector3::new(uniform(4e-3), uniform(4e-3), uniform(4e-3));
                let ray = (seen.normalize() + noise).normalize();
                let other = Vector3::new(uniform(6.0), uniform(6.0), uniform(3.0));
                Correspondence { ray, point: if k < wrong { other } else { point } }
            })
            .collect();
        (truth, pairs)
    }

    #[test]
    fn two_points_give_the_pose_among_at_most_two() {
        let (truth, mut pairs) = scene(2, 0);
        for pair in &mut pairs {
            pair.ray = truth.map_from_leveled.inverse().act(&(pair.point - truth.position)).normalize();
        }
        let found = from_two(&pairs[0], &pairs[1]);
        let error = |p: &LeveledPose| {
            (p.position - truth.position).norm()
                + (p.map_from_leveled.inverse() * truth.map_from_leveled).log().norm()
        };
        assert!(found.iter().any(|p| error(p) < 1e-9), "{found:?}");
    }

    #[test]
    fn the_pose_is_found_among_wrong_matches() {
        let (truth, pairs) = scene(80, 50);
        let found = estimate(&pairs, 2e-3).unwrap();
        assert!(found.inliers.iter().filter(|k| **k >= 50).count() >= 28, "{:?}", found.inliers);
        assert!((found.pose.position - truth.position).norm() < 5e-3);
        let turned = found.pose.map_from_leveled.inverse() * truth.map_from_leveled;
        assert!(turned.log().norm() < 2e-3);
    }

    #[test]
    fn points_seen_nowhere_together_agree_with_no_pose() {
        let (_, pairs) = scene(60, 60);
        let most = estimate(&pairs, 2e-3).map_or(0, |f| f.inliers.len());
        assert!(most < 10, "{most} of 60 random pairs agree");
    }
}
