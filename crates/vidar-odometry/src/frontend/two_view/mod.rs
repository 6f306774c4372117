//! The motion between two views from pairs of rays: consensus, then refinement.
//!
//! Five pairs give up to ten essential matrices, scored by the angle of rays to their epipolar planes (Sampson's first-order
//! distance, truncated) and refined on their inliers. Samples come from a fixed seed, so that the same
//! pairs give the same bits. The translation has length one: two views do not know the scale.

mod five_point;
mod random;
mod refine;
mod roots;
#[cfg(test)]
mod tests;
mod triangulate;

pub use triangulate::{Triangulated, triangulate};

use five_point::five_point;
use nalgebra::{Matrix3, Vector3};
use random::Sampler;
use vidar_core::{Se3, So3};
use vidar_solve::statistics::median_upper;

/// Angle to the epipolar plane up to which a pair agrees, standard deviations of a ray: of true pairs, one in eighty is beyond.
const THRESHOLD_SIGMAS: f64 = 2.5;

/// Fewest pairs that must agree: over twice the five that a wrong motion fits anyway.
const MIN_INLIERS: usize = 12;

/// Most samples that are drawn: with half of the pairs wrong, 200 samples of five hold a right one with [`CONFIDENCE`].
const MAX_SAMPLES: usize = 200;

/// Probability that one sample was free of wrong pairs.
const CONFIDENCE: f64 = 0.995;

/// Least median parallax, standard deviations of a ray. Below it a motion cannot be told from a rotation.
const MIN_PARALLAX_SIGMAS: f64 = 4.0;

/// Unit directions to one feature from two views, each in its own camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RayPair {
    /// In the first view.
    pub a: Vector3<f64>,
    /// In the second view.
    pub b: Vector3<f64>,
}

/// The motion between two views.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TwoView {
    /// Rotation, and translation of length one.
    pub b_from_a: Se3,
    /// Pairs that agree.
    pub inliers: usize,
    /// Root mean square angle of the agreeing rays to their epipolar planes, rad.
    pub rms_rad: f64,
    /// Median angle between the agreeing rays once the rotation is undone, rad.
    pub median_parallax_rad: f64,
    /// Samples drawn.
    pub samples: usize,
}

/// Why no motion was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TwoViewFailure {
    /// Fewer pairs than the method needs.
    TooFewPairs {
        /// Pairs given.
        found: usize,
        /// Pairs needed.
        needed: usize,
    },
    /// No motion satisfies enough pairs.
    NoConsensus {
        /// Most pairs that agreed.
        inliers: usize,
        /// Pairs that must.
        needed: usize,
    },
    /// The rays agree with a rotation alone: where the camera moved to cannot be told.
    NoParallax {
        /// Median angle between the rays once the rotation is undone, rad.
        median_rad: f64,
        /// Angle that is needed, rad.
        needed_rad: f64,
    },
}

/// Finds motions between views; its buffers are kept.
#[derive(Clone, Debug, Default)]
pub struct TwoViewSolver {
    inliers: Vec<bool>,
    scratch: Vec<f64>,
}

impl TwoViewSolver {
    /// Which pairs agreed in the last solution, in the order given.
    pub fn inliers(&self) -> &[bool] {
        &self.inliers
    }

    /// Rotation and direction of translation; `sigma_rad` is the error of a ray.
    ///
    /// # Errors
    /// Says what was missing. A motion without parallax has no answer.
    pub fn solve(&mut self, pairs: &[RayPair], sigma_rad: f64) -> Result<TwoView, TwoViewFailure> {
        self.check(pairs, 5)?;
        let limit2 = (THRESHOLD_SIGMAS * sigma_rad).powi(2);
        let mut search = Search::new(pairs.len());
        let mut sampler = Sampler::new(SEED);
        let mut found = [Matrix3::zeros(); 10];
        while search.goes_on(5) {
            let chosen: [usize; 5] = sampler.distinct(pairs.len());
            let (a, b) = (chosen.map(|i| pairs[i].a), chosen.map(|i| pairs[i].b));
            let count = five_point(&a, &b, &mut found);
            for essential in &found[..count] {
                let Some((rotations, direction)) = decompose(essential) else { continue };
                // Only one of the four motions has the sample in front of both cameras.
                for rotation in rotations {
                    for t in [direction, -direction] {
                        if chosen.iter().all(|i| is_in_front(&pairs[*i], &rotation, &t)) {
                            search.offer(pairs, &rotation, &t, limit2);
                        }
                    }
                }
            }
        }
        let solution = self.finish(pairs, search, sigma_rad)?;
        self.demand_parallax(pairs, &solution.b_from_a.rotation, sigma_rad)?;
        Ok(solution)
    }

    fn check(&mut self, pairs: &[RayPair], sample: usize) -> Result<(), TwoViewFailure> {
        let needed = MIN_INLIERS.max(sample + 1);
        self.inliers.clear();
        self.inliers.resize(pairs.len(), false);
        if pairs.len() < needed {
            return Err(TwoViewFailure::TooFewPairs { found: pairs.len(), needed });
        }
        Ok(())
    }

    fn median_parallax(&mut self, pairs: &[RayPair], rotation: &So3, only_inliers: bool) -> f64 {
        self.scratch.clear();
        let rotation = rotation.matrix();
        for (pair, inlier) in pairs.iter().zip(&self.inliers) {
            if *inlier || !only_inliers {
                let turned = rotation * pair.a;
                self.scratch.push(turned.cross(&pair.b).norm().atan2(turned.dot(&pair.b)));
            }
        }
        median_upper(&mut self.scratch).unwrap_or(0.0)
    }

    fn demand_parallax(
        &mut self,
        pairs: &[RayPair],
        rotation: &So3,
        sigma_rad: f64,
    ) -> Result<(), TwoViewFailure> {
        let median_rad = self.median_parallax(pairs, rotation, false);
        let needed_rad = MIN_PARALLAX_SIGMAS * sigma_rad;
        if median_rad < needed_rad {
            return Err(TwoViewFailure::NoParallax { median_rad, needed_rad });
        }
        Ok(())
    }

    fn finish(
        &mut self,
        pairs: &[RayPair],
        search: Search,
        sigma_rad: f64,
    ) -> Result<TwoView, TwoViewFailure> {
        let samples = search.drawn;
        let needed = MIN_INLIERS;
        let mut motion = search.best.ok_or(TwoViewFailure::NoConsensus { inliers: 0, needed })?;
        let limit = THRESHOLD_SIGMAS * sigma_rad;
        let mut count = self.mark(pairs, &motion, limit);
        for _ in 0..2 {
            let refined = refine::refine(pairs, &self.inliers, &motion, sigma_rad);
            let before = std::mem::take(&mut count);
            count = self.mark(pairs, &refined, limit);
            if count * 10 < before * 9 {
                // Refinement went astray; keep what the sample said.
                count = self.mark(pairs, &motion, limit);
                break;
            }
            motion = refined;
        }
        if count < needed {
            return Err(TwoViewFailure::NoConsensus { inliers: count, needed });
        }
        let median_parallax_rad = self.median_parallax(pairs, &motion.rotation, true);
        let rotation = motion.rotation.matrix();
        let squares: f64 = pairs
            .iter()
            .zip(&self.inliers)
            .filter(|(_, inlier)| **inlier)
            .map(|(pair, _)| plane_angle2(pair, &rotation, &motion.translation))
            .sum();
        Ok(TwoView {
            b_from_a: motion,
            inliers: count,
            rms_rad: (squares / count as f64).sqrt(),
            median_parallax_rad,
            samples,
        })
    }

    fn mark(&mut self, pairs: &[RayPair], motion: &Se3, limit_rad: f64) -> usize {
        let rotation = motion.rotation.matrix();
        let mut count = 0;
        for (pair, inlier) in pairs.iter().zip(&mut self.inliers) {
            let near = plane_angle2(pair, &rotation, &motion.translation) < limit_rad * limit_rad;
            *inlier = near && is_ahead(pair, &rotation, &motion.translation, limit_rad);
            count += usize::from(*inlier);
        }
        count
    }
}

/// Where samples begin; any number would do, as long as it stays.
const SEED: u64 = 0x5eed;

/// The best motion so far and how long to go on.
struct Search {
    best: Option<Se3>,
    cost: f64,
    inliers: usize,
    pairs: usize,
    drawn: usize,
    miss: f64,
}

impl Search {
    fn new(pairs: usize) -> Self {
        let miss = f64::ln(1.0 - CONFIDENCE);
        Self { best: None, cost: f64::INFINITY, inliers: 0, pairs, drawn: 0, miss }
    }

    /// Fischler & Bolles' number of samples for the share of inliers seen so far.
    fn goes_on(&mut self, sample: i32) -> bool {
        let share = self.inliers as f64 / self.pairs as f64;
        let good = share.powi(sample).clamp(1e-9, 1.0 - 1e-9);
        let enough = self.drawn as f64 * (1.0 - good).ln() <= self.miss;
        self.drawn += 1;
        self.drawn <= MAX_SAMPLES && !enough
    }

    /// Scores a motion by truncated squares (MSAC) and keeps it if it is the best.
    fn offer(&mut self, pairs: &[RayPair], rotation: &Matrix3<f64>, direction: &Vector3<f64>, limit2: f64) {
        let (mut cost, mut inliers) = (0.0, 0);
        let limit = limit2.sqrt();
        for pair in pairs {
            let angle2 = plane_angle2(pair, rotation, direction);
            if angle2 < limit2 && is_ahead(pair, rotation, direction, limit) {
                cost += angle2;
                inliers += 1;
            } else {
                cost += limit2;
            }
            if cost > self.cost {
                return;
            }
        }
        if let Some(rotation) = So3::from_matrix(rotation) {
            (self.cost, self.inliers) = (cost, inliers);
            self.best = Some(Se3::new(rotation, *direction));
        }
    }
}

/// Squared angle of the rays to their epipolar planes, to first order (Sampson).
fn plane_angle2(pair: &RayPair, rotation: &Matrix3<f64>, direction: &Vector3<f64>) -> f64 {
    let turned = rotation * pair.a;
    let error = direction.dot(&turned.cross(&pair.b));
    // Lengths of the planes' normals t × R a and t × b: the error's derivatives by the rays.
    let slope = direction.cross(&turned).norm_squared() + direction.cross(&pair.b).norm_squared();
    error * error / slope.max(1e-12)
}

/// Whether the rays meet in front of both cameras.
fn is_in_front(pair: &RayPair, rotation: &Matrix3<f64>, direction: &Vector3<f64>) -> bool {
    let turned = rotation * pair.a;
    let rays = turned.cross(&pair.b);
    // Distances along both rays have these signs.
    rays.dot(&direction.cross(&pair.b)) < 0.0 && rays.dot(&direction.cross(&turned)) < 0.0
}

/// As [`is_in_front`], but rays that are parallel within `limit_rad` may be at infinity.
fn is_ahead(pair: &RayPair, rotation: &Matrix3<f64>, direction: &Vector3<f64>, limit_rad: f64) -> bool {
    let turned = rotation * pair.a;
    let is_far = turned.cross(&pair.b).norm() < limit_rad && turned.dot(&pair.b) > 0.0;
    is_far || is_in_front(pair, rotation, direction)
}

/// The two rotations and the direction of translation (up to sign) of an essential matrix (Hartley & Zisserman, 9.6.2).
fn decompose(essential: &Matrix3<f64>) -> Option<([Matrix3<f64>; 2], Vector3<f64>)> {
    if !essential.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = essential.svd(true, true);
    let (mut u, mut v_t) = (svd.u?, svd.v_t?);
    // The translation is the left direction of the smallest singular value, wherever the decomposition put it.
    let smallest = svd.singular_values.imin();
    u.swap_columns(smallest, 2);
    v_t.swap_rows(smallest, 2);
    if u.determinant() < 0.0 {
        u = -u;
    }
    if v_t.determinant() < 0.0 {
        v_t = -v_t;
    }
    let quarter = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    Some(([u * quarter * v_t, u * quarter.transpose() * v_t], u.column(2).into_owned()))
}
