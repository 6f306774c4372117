//! Gyroscope–camera alignment: clock offset, rolling-shutter readout, rotation of the camera on the body and gyroscope
//! bias from feature tracks and gyroscope samples alone.
//!
//! For a pair of images the gyroscope gives the rotation between the exposure times of any two rows. With both rays of a
//! feature rotated to common axes, `w_i` and `w_j`, a static point satisfies the epipolar constraint
//! `(w_i × w_j) · t = 0`, where `t` is the pair's direction of translation between those rows ([`Translation`]). `t` has four degrees of freedom per pair and is
//! eliminated (variable projection: Golub, Pereyra 1973; the derivative is Kaufman's approximation). What remains is a
//! small nonlinear least-squares problem in the parameters. Without translation the products vanish for any `t`, so
//! turning on the spot needs no special case. Rows and clocks follow Jia, Evans, "Probabilistic 3-D motion estimation for
//! rolling shutter video rectification", 2012, and Kelly, Sukhatme, "A general framework for temporal calibration", 2014.

use super::path::{OrientationPath, RateSample};
use super::translation::{CAUCHY, Match, Residual, Translation};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use vidar_core::{CameraModel, LandmarkId, LieGroup, So3, camera::Pixel};

/// Parameters: clock offset (s), readout (s), rotation of the camera (rad, right perturbation), gyroscope bias (rad/s).
const DIM: usize = 8;
const OFFSET: usize = 0;
const READOUT: usize = 1;
const ROTATION: usize = 2;
const BIAS: usize = 5;

/// Orientations are interpolated linearly between so many row times per image: at 5 rad/s and 33 ms the chord of a
/// segment is off by less than 2e-5 rad.
const ROW_SEGMENTS: usize = 8;

/// Standard deviation of a feature's position in one image, pixels, tracking drift included.
const PIXEL_SIGMA: f64 = 0.7;

/// Each ray takes part in up to four pairs, and tracking errors last over many images, so residuals are correlated:
/// covariances are multiplied by this.
const SHARED_RAYS: f64 = 9.0;

/// The rotation of the camera is biased when parallax is small: on slow motion its error was up to ten times its formal
/// standard deviation (this module's tests), so that is multiplied by this.
const ROTATION_INFLATION: f64 = 6.0;

/// Standard deviations of the prior about the given values, in the order of the parameters.
const PRIOR: [f64; DIM] = [0.1, 0.02, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05];

/// Steps of the numeric derivatives.
const STEPS: [f64; DIM] = [1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4];

/// The clock offset is searched on a grid of ±[`SEARCH_SECS`] in steps of [`SEARCH_STEP_SECS`]; the optimum's basin is as
/// wide as the fastest change of rate allows, some 30 ms for a lively hand.
const SEARCH_SECS: f64 = 0.15;
const SEARCH_STEP_SECS: f64 = 0.0125;
/// Pairs of images that the search looks at, evenly over all: it has to find the basin only, and tries 25 offsets.
const SEARCH_PAIRS: usize = 40;

/// Feature positions in one image. `secs`: the image's stamp, before any clock offset, since the common origin.
#[derive(Clone, Debug)]
pub(crate) struct ImageFeatures {
    pub secs: f64,
    /// In the order of ids.
    pub features: Vec<(LandmarkId, Pixel)>,
}

/// The parameters and how well they are known.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Alignment {
    /// `t_imu = stamp + offset`, s.
    pub offset_secs: f64,
    /// Time from the first to the last row, s; stamps are those of the centre row once the offset is added.
    pub readout_secs: f64,
    /// Rotation body_from_camera.
    pub body_from_camera: So3,
    /// Standard deviations: offset (s), readout (s), rotation (rad, the largest of three axes).
    pub offset_sigma: f64,
    pub readout_sigma: f64,
    pub rotation_sigma: f64,
    /// Mean squared whitened residual.
    pub chi2_per_dof: f64,
}

/// Matches of one pair of images: indices of the images and of their features.
#[derive(Clone)]
struct Pair {
    images: [usize; 2],
    matches: Vec<[usize; 2]>,
    /// In common axes, at the last linearisation.
    translation: Translation,
}

/// The problem: images with unit rays in the camera, and pairs.
pub(crate) struct Problem<'a> {
    camera: &'a CameraModel,
    samples: &'a [RateSample],
    images: &'a [ImageFeatures],
    rays: Rays,
    pairs: Vec<Pair>,
    /// Per image, whether a pair shows it.
    is_shown: Vec<bool>,
    given: So3,
    ray_sigma: f64,
    /// Only the clock's basin is asked for: one direction of translation for all rows will do, at half the cost.
    is_coarse: bool,
}

/// Per image and feature, the ray in camera or common axes; `None` where the camera has none for the pixel.
type Rays = Vec<Vec<Option<Vector3<f64>>>>;

type Parameters = SVector<f64, DIM>;

impl<'a> Problem<'a> {
    /// `images` and `samples` in the order of time; pairs are images about 0.1 and 0.25 s apart.
    pub fn new(
        camera: &'a CameraModel,
        body_from_camera: So3,
        images: &'a [ImageFeatures],
        samples: &'a [RateSample],
    ) -> Self {
        let ray = |(_, pixel): &(LandmarkId, Pixel)| camera.unproject(pixel);
        let rays = images.iter().map(|i| i.features.iter().map(ray).collect()).collect();
        let mut pairs = Vec::new();
        for (k, image) in images.iter().enumerate() {
            for apart in [0.1, 0.25] {
                let Some(j) = (k + 1..images.len()).find(|j| images[*j].secs - image.secs >= apart) else {
                    continue;
                };
                if images[j].secs - image.secs < apart + 0.15 {
                    let matches = common(image, &images[j]);
                    if matches.len() >= 12 {
                        pairs.push(Pair { images: [k, j], matches, translation: Translation::default() });
                    }
                }
            }
        }
        let ray_sigma = PIXEL_SIGMA / camera.intrinsics().fx;
        let is_shown = shown(&pairs, images.len());
        let given = body_from_camera;
        Self { camera, samples, images, rays, pairs, is_shown, given, ray_sigma, is_coarse: false }
    }

    /// The same problem with at most `most` of its pairs, for the clock's basin.
    fn coarse(&self, most: usize) -> Self {
        let stride = self.pairs.len().div_ceil(most).max(1);
        let pairs: Vec<Pair> = self.pairs.iter().step_by(stride).cloned().collect();
        let is_shown = shown(&pairs, self.images.len());
        Self { pairs, is_shown, rays: self.rays.clone(), is_coarse: true, ..*self }
    }

    /// Number of pairs of images.
    pub fn pair_count(&self) -> usize {
        self.pairs.len()
    }

    /// Solves for all parameters; `start` is the best guess of the clock offset and readout. `search` tries offsets over
    /// the whole range first.
    pub fn solve(&mut self, start: (f64, f64), search: bool) -> Option<Alignment> {
        let mut x = Parameters::zeros();
        (x[OFFSET], x[READOUT]) = start;
        let prior = x;
        if search {
            let mut coarse = self.coarse(SEARCH_PAIRS);
            let steps = (2.0 * SEARCH_SECS / SEARCH_STEP_SECS).round() as i32;
            let mut best = f64::INFINITY;
            for k in 0..=steps {
                let mut trial = prior;
                trial[OFFSET] = -SEARCH_SECS + f64::from(k) * SEARCH_STEP_SECS;
                let only_bias = |p: usize| p >= BIAS;
                coarse.iterate(&mut trial, &prior, only_bias, 2)?;
                let (_, _, cost) = coarse.linearise(&trial, |_| false);
                if cost < best {
                    (best, x) = (cost, trial);
                }
            }
        }
        self.iterate(&mut x, &prior, |p| p == OFFSET || p >= BIAS, 6)?;
        self.iterate(&mut x, &prior, |_| true, 10)?;
        let (mut h, _, _) = self.linearise(&x, |_| true);
        let chi2 = self.chi2_per_dof(&x);
        for p in 0..DIM {
            h[(p, p)] += 1.0 / (PRIOR[p] * PRIOR[p]);
        }
        let covariance = h.try_inverse()? * (SHARED_RAYS * chi2.max(1.0));
        let sigma = |p: usize| covariance[(p, p)].sqrt();
        let alignment = Alignment {
            offset_secs: x[OFFSET],
            readout_secs: x[READOUT],
            body_from_camera: self.rotation(&x),
            offset_sigma: sigma(OFFSET),
            readout_sigma: sigma(READOUT),
            rotation_sigma: ROTATION_INFLATION * (ROTATION..ROTATION + 3).map(sigma).fold(0.0, f64::max),
            chi2_per_dof: chi2,
        };
        (x.iter().all(|v| v.is_finite()) && alignment.offset_sigma.is_finite()).then_some(alignment)
    }

    fn rotation(&self, x: &Parameters) -> So3 {
        self.given * So3::exp(&Vector3::new(x[ROTATION], x[ROTATION + 1], x[ROTATION + 2]))
    }

    /// Gauss-Newton over the parameters that `is_free` names.
    fn iterate(
        &mut self,
        x: &mut Parameters,
        prior: &Parameters,
        is_free: impl Fn(usize) -> bool + Copy,
        rounds: usize,
    ) -> Option<()> {
        for _ in 0..rounds {
            let (mut h, mut g, _) = self.linearise(x, is_free);
            for p in 0..DIM {
                let information = 1.0 / (PRIOR[p] * PRIOR[p]);
                if is_free(p) {
                    h[(p, p)] += information;
                    g[p] += information * (prior[p] - x[p]);
                } else {
                    (h[(p, p)], g[p]) = (1.0, 0.0);
                }
            }
            let mut step = h.cholesky()?.solve(&g);
            // A step beyond the basin of the clock is cut; the others follow in proportion.
            let cut = (0.02 / step[OFFSET].abs().max(1e-12)).min(1.0);
            step *= cut;
            *x += step;
            x[OFFSET] = x[OFFSET].clamp(-1.2 * SEARCH_SECS, 1.2 * SEARCH_SECS);
            x[READOUT] = x[READOUT].clamp(-0.01, 0.06);
            if step[OFFSET].abs() < 1e-5 && step[READOUT].abs() < 1e-4 && step.norm() < 1e-3 {
                break;
            }
        }
        Some(())
    }

    /// All rays in common axes for the parameters `x`.
    fn turned(&self, x: &Parameters) -> Rays {
        let path = OrientationPath::new(self.samples, &bias_of(x));
        let body_from_camera = self.rotation(x);
        let last_row = self.camera.height() as f64 - 1.0;
        let turn_image = |k: usize| {
            let (image, rays) = (&self.images[k], &self.rays[k]);
            if !self.is_shown[k] {
                return Vec::new();
            }
            let row_turns: Vec<Matrix3<f64>> = (0..=ROW_SEGMENTS)
                .map(|k| {
                    let row = k as f64 / ROW_SEGMENTS as f64 - 0.5;
                    (path.at(image.secs + x[OFFSET] + row * x[READOUT]) * body_from_camera).matrix()
                })
                .collect();
            let turn = |((_, pixel), ray): (&(LandmarkId, Pixel), &Option<Vector3<f64>>)| {
                let at = (pixel.y / last_row).clamp(0.0, 1.0) * ROW_SEGMENTS as f64;
                let k = (at as usize).min(ROW_SEGMENTS - 1);
                let part = at - k as f64;
                ray.map(|r| row_turns[k] * r * (1.0 - part) + row_turns[k + 1] * r * part)
            };
            image.features.iter().zip(rays).map(turn).collect()
        };
        (0..self.images.len()).map(turn_image).collect()
    }

    /// Normal equations `H δ = g` without prior, and the robust cost; directions of translation are updated.
    fn linearise(
        &mut self,
        x: &Parameters,
        is_free: impl Fn(usize) -> bool,
    ) -> (SMatrix<f64, DIM, DIM>, Parameters, f64) {
        let at = self.turned(x);
        let moved: Vec<Option<Rays>> = (0..DIM)
            .map(|p| {
                is_free(p).then(|| {
                    let mut there = *x;
                    there[p] += STEPS[p];
                    self.turned(&there)
                })
            })
            .collect();
        let (mut h, mut g, mut cost) = (SMatrix::<f64, DIM, DIM>::zeros(), Parameters::zeros(), 0.0);
        let (ray_sigma, rows) = (self.ray_sigma, Rows::of(self));
        for pair in &mut self.pairs {
            let seen = pair.matches.iter().filter_map(|m| rows.seen(pair.images, m, &at));
            pair.translation = match self.is_coarse {
                true => Translation::of_centre_rows(seen, ray_sigma),
                false => Translation::of(seen, ray_sigma, &pair.translation),
            };
            let mut h_pair = SMatrix::<f64, DIM, DIM>::zeros();
            let mut g_pair = Parameters::zeros();
            let mut cross = SMatrix::<f64, DIM, 4>::zeros();
            let (mut tt, mut tg) = pair.translation.prior();
            for m in &pair.matches {
                let Some(seen) = rows.seen(pair.images, m, &at) else { continue };
                let Residual { value: r, weight, by_translation: jt, by_normal, sigma } =
                    pair.translation.residual(&seen, ray_sigma);
                // The kernel's loss up to rounding.
                cost += 0.5 * CAUCHY * CAUCHY * (1.0 + r * r / (CAUCHY * CAUCHY)).ln();
                let mut j = Parameters::zeros();
                for p in 0..DIM {
                    let there = moved[p].as_ref().and_then(|rays| rows.seen(pair.images, m, rays));
                    if let Some(there) = there {
                        j[p] = (there.normal - seen.normal).dot(&by_normal) / (STEPS[p] * sigma);
                    }
                }
                h_pair += j * j.transpose() * weight;
                g_pair -= j * (r * weight);
                cross += j * jt.transpose() * weight;
                tt += jt * jt.transpose() * weight;
                tg -= jt * (r * weight);
            }
            if let Some(inverse) = tt.try_inverse() {
                h_pair -= cross * inverse * cross.transpose();
                g_pair -= cross * inverse * tg;
            }
            h += h_pair;
            g += g_pair;
        }
        (h, g, cost)
    }

    fn chi2_per_dof(&self, x: &Parameters) -> f64 {
        let at = self.turned(x);
        let (mut sum, mut weights) = (0.0, 0.0);
        let rows = Rows::of(self);
        for pair in &self.pairs {
            for seen in pair.matches.iter().filter_map(|m| rows.seen(pair.images, m, &at)) {
                let r = pair.translation.residual(&seen, self.ray_sigma);
                sum += r.weight * r.value * r.value;
                weights += r.weight;
            }
        }
        if weights > 0.0 { sum / weights } else { f64::INFINITY }
    }
}

/// Where images show features, for the rows of matches.
#[derive(Clone, Copy)]
struct Rows<'a> {
    images: &'a [ImageFeatures],
    last: f64,
}

impl<'a> Rows<'a> {
    fn of(problem: &Problem<'a>) -> Self {
        Self { images: problem.images, last: problem.camera.height() as f64 - 1.0 }
    }

    /// A match of two images, given all rays; `None` where the camera has no ray for a pixel.
    fn seen(&self, images: [usize; 2], features: &[usize; 2], rays: &Rays) -> Option<Match> {
        let [i, j] = images;
        let (a, b) = (rays[i][features[0]]?, rays[j][features[1]]?);
        let row = |image: usize, feature: usize| self.images[image].features[feature].1.y;
        let mean = 0.5 * (row(i, features[0]) + row(j, features[1]));
        Some(Match { normal: a.cross(&b), rays: [a, b], row: mean / self.last - 0.5 })
    }
}

fn shown(pairs: &[Pair], images: usize) -> Vec<bool> {
    let mut is_shown = vec![false; images];
    pairs.iter().flat_map(|p| p.images).for_each(|k| is_shown[k] = true);
    is_shown
}

fn bias_of(x: &Parameters) -> Vector3<f64> {
    Vector3::new(x[BIAS], x[BIAS + 1], x[BIAS + 2])
}

/// Indices of features that both images show, both in the order of ids.
pub(crate) fn common(a: &ImageFeatures, b: &ImageFeatures) -> Vec<[usize; 2]> {
    let (mut i, mut j, mut out) = (0, 0, Vec::new());
    while i < a.features.len() && j < b.features.len() {
        match a.features[i].0.cmp(&b.features[j].0) {
            std::cmp::Ordering::Less => i += 1,
            std::cmp::Ordering::Greater => j += 1,
            std::cmp::Ordering::Equal => {
                out.push([i, j]);
                (i, j) = (i + 1, j + 1);
            }
        }
    }
    out
}
