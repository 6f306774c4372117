//! How the images of a stretch turn otherwise than the gyroscope says: what its drift is worth.

use super::{FIXED, NODE, Node, Window};
use crate::calibration::parameters::Parameters;
use crate::calibration::path::GyroPath;
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, SVector, Vector3};
use vidar_core::{LieGroup, So3};

/// What a stabiliser can tell from a turn that is meant: shakes of these time constants, s. Lenses and sensors on springs follow for a tenth to half a second,
/// software for longer; a mixture of both passes stands for what is between.
const SHAKE_SECS: [f64; 2] = [0.15, 1.0];
/// How many they are: of each time constant the part that moves the picture, which a lens can take back, and the part that turns it about its middle, which only
/// software does.
pub(super) const SHAKES: usize = 2 * SHAKE_SECS.len();
/// A shake's rate is that within so much around an image, s: the longest readout.
const RATE_SECS: f64 = 0.015;
/// Standard deviation of the share that is taken back of each.
const SHARE_SIGMA: f64 = 0.5;
/// Ages, in time constants, at which a turn is asked: middles of quarters of the weight exp(−age).
const AGES: [f64; 4] = [0.134, 0.470, 0.981, 2.079];

/// Bounds of the standard deviation of an image's rotation, rad: below, drift of the gyroscope; above, images turn by themselves.
const SHIFT_SIGMA: (f64, f64) = (0.001, 0.03);
/// The one that a search begins with, rad: half of what lenses of phones can be moved by.
const FIRST_SHIFT_SIGMA: f64 = 0.01;

/// What is believed of how images turn against the gyroscope.
#[derive(Clone, Copy, Debug)]
pub(in crate::calibration) enum Turns {
    /// As it measures, but for its white noise, rad/s/√Hz: their drift is a random walk from the reference on.
    Gyroscope(f64),
    /// As a stabiliser leaves them: shares of the shake are taken back, and each image is turned by itself, by so much (σ, rad).
    Stabilised(f64),
}

/// The shake of each image of a stretch, and the shares of it that a stabiliser takes back: a stretch has them while one is looked for.
#[derive(Clone, Debug)]
pub(in crate::calibration) struct Shakes {
    /// How far each image is turned from where the camera was meant to look: in the reference's body axes, rad.
    of_nodes: Vec<[Vector3<f64>; SHAKES]>,
    /// How fast that changes, rad/s.
    rates: Vec<[Vector3<f64>; SHAKES]>,
    /// The part of each kind of shake that is taken back.
    pub(super) shares: SVector<f64, SHAKES>,
}

impl Turns {
    /// What a search for a stabiliser begins with.
    pub const STABILISED: Self = Self::Stabilised(FIRST_SHIFT_SIGMA);

    /// Whether images are turned by a stabiliser.
    pub const fn is_stabilised(&self) -> bool {
        matches!(self, Self::Stabilised(_))
    }
}

impl Shakes {
    /// How fast the shakes of a node change, rad/s.
    pub(super) fn rates(&self, node: usize) -> &[Vector3<f64>; SHAKES] {
        &self.rates[node]
    }

    /// What is taken back within some seconds after a node's own time, rad.
    pub(super) fn taken_back(&self, node: usize, secs: f64) -> Vector3<f64> {
        self.rates[node].iter().zip(&self.shares).map(|(rate, share)| rate * (share * secs)).sum()
    }

    /// By how much a drift goes beyond what the shares of its node's shake say.
    fn beyond(&self, node: usize, drift: &Vector3<f64>) -> Vector3<f64> {
        let shakes = self.of_nodes[node].iter().zip(&self.shares);
        drift + shakes.map(|(shake, share)| shake * *share).sum::<Vector3<f64>>()
    }
}

/// The parts of a drift that turn the camera, as the gyroscope's error does, and that a stabiliser moves the picture by. The difference is a keystone: 2.5 px at
/// the side of a picture that is 77° wide and 640 px, for 1°. With turns alone focal lengths came out up to 7 % short, with residuals half as large again.
pub(super) fn turn_and_shift(
    drift: &Vector3<f64>,
    reference_from_camera: &Matrix3<f64>,
) -> [Vector3<f64>; 2] {
    let view = reference_from_camera.column(2);
    let about_the_view = view * view.dot(drift);
    [about_the_view, drift - about_the_view]
}

/// The derivatives of a pixel by such a drift, from those by a rotation and by a shift of the picture.
pub(super) fn by_turn_and_shift(
    by_turn: &Matrix2x3<f64>,
    by_shift: &Matrix2x3<f64>,
    camera_from_reference: &Matrix3<f64>,
) -> Matrix2x3<f64> {
    let view = camera_from_reference.row(2);
    let about_the_view = view.transpose() * view;
    by_turn * about_the_view + by_shift * (Matrix3::identity() - about_the_view)
}

impl Window {
    /// Takes the shake of each image from the gyroscope, for a stabiliser to take back.
    pub fn find_shakes(&mut self, parameters: &Parameters, path: &GyroPath) {
        let rotation = |secs: f64| path.at(secs + parameters.offset_secs).rotation;
        let reference_from_first = rotation(self.nodes[self.reference].secs).transpose();
        let axis = parameters.body_from_camera.matrix().column(2).into_owned();
        let shakes = |secs: f64| {
            let now = rotation(secs);
            let view = reference_from_first * now * axis;
            let turned = |before: f64| {
                let since = rotation(secs - before).transpose() * now;
                So3::from_matrix(&since).map_or_else(Vector3::zeros, |turn| turn.log())
            };
            let [fast, slow] = SHAKE_SECS.map(|constant| {
                let sum: Vector3<f64> = AGES.iter().map(|age| turned(age * constant)).sum();
                let shake = reference_from_first * now * (sum / AGES.len() as f64);
                let about_the_view = view * view.dot(&shake);
                [shake - about_the_view, about_the_view]
            });
            [fast[0], fast[1], slow[0], slow[1]]
        };
        let (of_nodes, rates) = self
            .nodes
            .iter()
            .map(|node| {
                let [before, after] = [-RATE_SECS, RATE_SECS].map(|secs| shakes(node.secs + secs));
                let rates = std::array::from_fn(|j| (after[j] - before[j]) / (2.0 * RATE_SECS));
                (shakes(node.secs), rates)
            })
            .unzip();
        let shares = self.shakes.as_ref().map_or_else(SVector::zeros, |known| known.shares);
        self.shakes = Some(Shakes { of_nodes, rates, shares });
    }

    /// What the nodes' rotations are off, which is believed to be zero: of the gyroscope's walk from each to the next, or of each from what a stabiliser leaves.
    /// Each with its standard deviation, rad.
    pub(in crate::calibration) fn off_turns(&self, turns: &Turns) -> Vec<(Vector3<f64>, f64)> {
        match turns {
            Turns::Gyroscope(noise) => {
                let pairs = self.nodes.windows(2);
                let sigma = |secs: f64| noise * secs.max(1e-3).sqrt();
                pairs.map(|p| (p[1].drift - p[0].drift, sigma(p[1].secs - p[0].secs))).collect()
            }
            Turns::Stabilised(sigma) => {
                let beyond = |(k, node): (usize, &Node)| {
                    self.shakes.as_ref().map_or(node.drift, |shakes| shakes.beyond(k, &node.drift))
                };
                self.nodes.iter().enumerate().map(|node| (beyond(node), *sigma)).collect()
            }
        }
    }

    /// Twice the cost of the rotations.
    pub(super) fn turns_chi2(&self, turns: &Turns) -> f64 {
        let off = self.off_turns(turns).into_iter();
        let off: f64 = off.map(|(off, sigma)| off.norm_squared() / (sigma * sigma)).sum();
        let held = match (turns, &self.shakes) {
            (Turns::Gyroscope(_), _) => self.nodes[self.reference].drift.norm_squared() / (FIXED * FIXED),
            (Turns::Stabilised(_), Some(shakes)) => {
                shakes.shares.norm_squared() / (SHARE_SIGMA * SHARE_SIGMA)
            }
            (Turns::Stabilised(_), None) => 0.0,
        };
        off + held
    }

    /// Its derivatives (lower triangle).
    pub(super) fn add_turns(&self, h: &mut DMatrix<f64>, g: &mut DVector<f64>, turns: &Turns) {
        match (turns, &self.shakes) {
            (Turns::Stabilised(_), Some(shakes)) => self.add_shifts(h, g, turns, shakes),
            _ => self.add_walk(h, g, turns),
        }
    }

    /// The gyroscope's: from each node to the next, from the reference on.
    fn add_walk(&self, h: &mut DMatrix<f64>, g: &mut DVector<f64>, turns: &Turns) {
        for (k, (off, sigma)) in self.off_turns(turns).into_iter().enumerate() {
            let weight = 1.0 / (sigma * sigma);
            for a in 0..3 {
                let (i, j) = (NODE * k + a, NODE * (k + 1) + a);
                h[(i, i)] += weight;
                h[(j, j)] += weight;
                h[(j, i)] -= weight;
                g[i] += weight * off[a];
                g[j] -= weight * off[a];
            }
        }
        let weight = 1.0 / (FIXED * FIXED);
        for a in 0..3 {
            let at = NODE * self.reference + a;
            h[(at, at)] += weight;
            g[at] -= weight * self.nodes[self.reference].drift[a];
        }
    }

    /// A stabiliser's: of each node by itself, and of the shares.
    fn add_shifts(&self, h: &mut DMatrix<f64>, g: &mut DVector<f64>, turns: &Turns, shakes: &Shakes) {
        let shares = NODE * self.nodes.len();
        for j in 0..SHAKES {
            h[(shares + j, shares + j)] += 1.0 / (SHARE_SIGMA * SHARE_SIGMA);
            g[shares + j] -= shakes.shares[j] / (SHARE_SIGMA * SHARE_SIGMA);
        }
        for (k, (off, sigma)) in self.off_turns(turns).into_iter().enumerate() {
            let weight = 1.0 / (sigma * sigma);
            for a in 0..3 {
                let (i, r) = (NODE * k + a, off[a]);
                h[(i, i)] += weight;
                g[i] -= weight * r;
                let shakes = shakes.of_nodes[k].map(|shake| shake[a]);
                for (m, shake) in shakes.iter().enumerate() {
                    h[(shares + m, i)] += weight * shake;
                    g[shares + m] -= weight * shake * r;
                    for (n, other) in shakes.iter().enumerate().take(m + 1) {
                        h[(shares + m, shares + n)] += weight * shake * other;
                    }
                }
            }
        }
    }
}

/// The standard deviation of images' rotations in stabilised stretches, rad.
pub(in crate::calibration) fn shift_sigma(windows: &[Window], turns: &Turns) -> f64 {
    let off = windows.iter().flat_map(|window| window.off_turns(turns));
    rms_per_axis(off.map(|(off, _)| off)).clamp(SHIFT_SIGMA.0, SHIFT_SIGMA.1)
}

/// Root mean square of the components; zero of none.
pub(in crate::calibration) fn rms_per_axis(vectors: impl Iterator<Item = Vector3<f64>>) -> f64 {
    let (count, sum) = vectors.fold((0, 0.0), |(n, sum), vector| (n + 3, sum + vector.norm_squared()));
    (sum / f64::from(count.max(1))).sqrt()
}
