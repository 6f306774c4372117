//! Which view gives a triangle its colours.
//!
//! A view's quality for a triangle is the area that the triangle covers in its image: it falls with the angle and with the
//! square of the distance. It is less where something may stand in front, and where the view's colour is not that of most views.

use super::{TextureCamera, TextureImage};
use crate::render::{Eye, RUN, SurfaceRenderer};
use rayon::prelude::*;
use vidar_core::{Image, TriangleMesh};

/// The label of a triangle that no view shows.
pub(super) const NO_VIEW: u32 = u32::MAX;
/// Views remembered for a triangle, the best ones.
const KEPT: usize = 6;
/// A view of at least this share of the best quality is as good as the best, if that makes larger charts.
const GOOD_SHARE: f32 = 0.5;
/// A corner this near to the border of the image, pixels, is not in it: interpolation needs a neighbour.
const MARGIN_PX: f32 = 1.0;
/// How far behind the nearest surface a point may lie and still be on it, as a share of its depth: rounding to pixels on slanted
/// surfaces. The length of the triangle's edges comes on top.
const DEPTH_SLACK: f32 = 0.01;
/// How much nearer, as a share of the depth, the view's own depth must be to say that something else is seen there. Five
/// standard deviations of stereo.
const OCCLUDED_SHARE: f32 = 0.05;
/// Distance in pixels from a contour within which colours may be those of the surface in front: errors of poses and contours.
const CONTOUR_PX: f32 = 3.0;
/// Difference in a channel, of 255, from the median of all views beyond which a view shows something else, or its reflection.
const OUTLIER: i32 = 60;
/// What remains of the quality beside a contour; without own depth; where own depth or colour speak against the view.
const BESIDE_CONTOUR: f32 = 0.25;
const WITHOUT_DEPTH: f32 = 0.5;
const CONTRADICTED: f32 = 0.05;
/// Cost of a neighbour of another view, against 1 for a view without any quality.
const SEAM_COST: f32 = 0.5;
/// Passes over all triangles in which labels follow their neighbours; few change after the third.
const SWEEPS: usize = 5;

#[derive(Clone, Copy, Debug)]
struct Candidate {
    view: u32,
    quality: f32,
    color: [u8; 3],
}

const NONE: Candidate = Candidate { view: NO_VIEW, quality: 0.0, color: [0; 3] };

/// The best views of each triangle.
pub(super) struct Candidates<'m> {
    mesh: &'m TriangleMesh,
    renderer: SurfaceRenderer<'m>,
    best: Vec<[Candidate; KEPT]>,
}

impl<'m> Candidates<'m> {
    pub fn new(mesh: &'m TriangleMesh) -> Self {
        let best = vec![[NONE; KEPT]; mesh.triangles.len()];
        Self { mesh, renderer: SurfaceRenderer::new(mesh), best }
    }

    /// Offers a view to all triangles; views must come in the order of their numbers.
    pub fn add(&mut self, view: u32, camera: &TextureCamera, image: &TextureImage) {
        let (nearest, eye) = self.renderer.nearest(&camera.world_from_camera, &camera.intrinsics);
        let evaluator = Evaluator { eye: &eye, nearest: &nearest, image };
        let (mesh, spheres) = (self.mesh, self.renderer.spheres());
        let runs = self.best.par_chunks_mut(RUN).zip(mesh.triangles.par_chunks(RUN)).zip(spheres);
        runs.filter(|(_, sphere)| eye.may_see(sphere)).for_each(|((best, triangles), _)| {
            for (best, triangle) in best.iter_mut().zip(triangles) {
                if let Some((quality, color)) = evaluator.quality(mesh, triangle) {
                    let worse = best.iter().position(|b| quality > b.quality);
                    if let Some(at) = worse {
                        best[at..].rotate_right(1);
                        best[at] = Candidate { view, quality, color };
                    }
                }
            }
        });
    }
}

/// One view, ready to be evaluated triangle by triangle.
struct Evaluator<'a> {
    eye: &'a Eye,
    /// z-depth of the nearest surface, either side; infinite where there is none.
    nearest: &'a Image<f32>,
    image: &'a TextureImage,
}

impl Evaluator<'_> {
    /// How well the view shows a triangle, pixels, and the colour at its centre; `None` where it does not show it.
    fn quality(&self, mesh: &TriangleMesh, triangle: &[u32; 3]) -> Option<(f32, [u8; 3])> {
        let (right, bottom) =
            (self.nearest.width() as f32 - 1.0 - MARGIN_PX, self.nearest.height() as f32 - 1.0 - MARGIN_PX);
        let mut corners = [[0.0; 3]; 3];
        for (corner, index) in corners.iter_mut().zip(triangle) {
            *corner = self.eye.project(&mesh.positions[*index as usize])?;
            let [x, y, _] = *corner;
            if !(x >= MARGIN_PX && y >= MARGIN_PX && x <= right && y <= bottom) {
                return None;
            }
        }
        let [a, b, c] = corners;
        // Rows point down, so the observed side has a negative area.
        let area = 0.5 * ((b[1] - a[1]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[1] - a[1]));
        if !(area > 0.0) {
            return None;
        }
        let center = [0, 1, 2].map(|i| (a[i] + b[i] + c[i]) / 3.0);
        let slack = |z: f32| DEPTH_SLACK * z + longest_edge(mesh, triangle);
        let is_hidden = |p: &[f32; 3]| {
            let z = 1.0 / p[2];
            at(self.nearest, p[0], p[1]) < z - slack(z)
        };
        if corners.iter().any(is_hidden) || is_hidden(&center) {
            return None;
        }
        let z = 1.0 / center[2];
        let mut quality = area;
        let around = [(CONTOUR_PX, 0.0), (-CONTOUR_PX, 0.0), (0.0, CONTOUR_PX), (0.0, -CONTOUR_PX)];
        let before = z * (1.0 - OCCLUDED_SHARE) - slack(z);
        if around.iter().any(|(dx, dy)| at(self.nearest, center[0] + dx, center[1] + dy) < before) {
            quality *= BESIDE_CONTOUR;
        }
        if let Some(depth) = &self.image.depth {
            let to = |c: f32, of: usize, size: usize| (c + 0.5) * of as f32 / size as f32 - 0.5;
            let x = to(center[0], depth.width(), self.nearest.width());
            let own = at(depth, x, to(center[1], depth.height(), self.nearest.height()));
            quality *= match own {
                own if own.is_nan() => WITHOUT_DEPTH,
                own if own < before => CONTRADICTED,
                _ => 1.0,
            };
        }
        Some((quality, at(&self.image.color, center[0], center[1])))
    }
}

/// The pixel nearest to a place, or of the border.
fn at<T: Copy>(image: &Image<T>, x: f32, y: f32) -> T {
    // `as` saturates.
    let column = (x.round() as usize).min(image.width() - 1);
    image[(column, (y.round() as usize).min(image.height() - 1))]
}

/// The largest extent of a triangle along an axis, metres.
fn longest_edge(mesh: &TriangleMesh, triangle: &[u32; 3]) -> f32 {
    let [a, b, c] = triangle.map(|i| mesh.positions[i as usize]);
    let extent = |i: usize| a[i].max(b[i]).max(c[i]) - a[i].min(b[i]).min(c[i]);
    extent(0).max(extent(1)).max(extent(2))
}

/// The view of each triangle, or [`NO_VIEW`].
///
/// The view that shows most triangles well takes all of them, then the one that shows most of the rest, and so on: few views,
/// large charts. Then each triangle follows its neighbours where that costs little quality.
pub(super) fn labels(candidates: Candidates<'_>, neighbours: &[[u32; 3]], views: usize) -> Vec<u32> {
    let mut best = candidates.best;
    best.par_iter_mut().for_each(doubt_outliers);
    let mut labels = greedy(&best, views);
    for _ in 0..SWEEPS {
        for triangle in 0..labels.len() {
            if labels[triangle] != NO_VIEW {
                labels[triangle] =
                    cheapest(&best[triangle], labels[triangle], &neighbours[triangle], &labels);
            }
        }
    }
    labels
}

/// Lowers the quality of views whose colour is not that of most, and sorts them again.
fn doubt_outliers(best: &mut [Candidate; KEPT]) {
    let known = best.iter().filter(|c| c.view != NO_VIEW).count();
    if known < 3 {
        return;
    }
    let median = [0, 1, 2].map(|channel| {
        let mut values: Vec<u8> = best[..known].iter().map(|c| c.color[channel]).collect();
        values.sort_unstable();
        i32::from(values[known / 2])
    });
    for candidate in &mut best[..known] {
        let differs = |c: usize| (i32::from(candidate.color[c]) - median[c]).abs() > OUTLIER;
        if (0..3).any(differs) {
            candidate.quality *= CONTRADICTED;
        }
    }
    best.sort_by(|a, b| b.quality.total_cmp(&a.quality).then(a.view.cmp(&b.view)));
}

/// The views that are as good as the best.
fn good(best: &[Candidate; KEPT]) -> impl Iterator<Item = u32> {
    let least = GOOD_SHARE * best[0].quality;
    best.iter().filter(move |c| c.view != NO_VIEW && c.quality >= least).map(|c| c.view)
}

fn greedy(best: &[[Candidate; KEPT]], views: usize) -> Vec<u32> {
    let mut shown: Vec<Vec<u32>> = vec![Vec::new(); views];
    for (triangle, best) in best.iter().enumerate() {
        good(best).for_each(|view| shown[view as usize].push(triangle as u32));
    }
    let mut count: Vec<usize> = shown.iter().map(Vec::len).collect();
    let mut labels = vec![NO_VIEW; best.len()];
    while let Some((view, most)) = count.iter().copied().enumerate().max_by_key(|&(i, n)| (n, usize::MAX - i))
        && most > 0
    {
        for triangle in std::mem::take(&mut shown[view]) {
            let label = &mut labels[triangle as usize];
            if *label == NO_VIEW {
                *label = view as u32;
                good(&best[triangle as usize]).for_each(|other| count[other as usize] -= 1);
            }
        }
    }
    labels
}

/// The view of a triangle that costs least, given those of its neighbours; the present one among equals.
fn cheapest(best: &[Candidate; KEPT], present: u32, neighbours: &[u32; 3], labels: &[u32]) -> u32 {
    let others = neighbours.map(|n| labels.get(n as usize).copied().unwrap_or(NO_VIEW));
    let cost = |c: &Candidate| {
        let seams = others.iter().filter(|o| **o != NO_VIEW && **o != c.view).count();
        1.0 - c.quality / best[0].quality.max(f32::MIN_POSITIVE) + SEAM_COST * seams as f32
    };
    let known = best.iter().filter(|c| c.view != NO_VIEW);
    let least =
        known.min_by(|a, b| cost(a).total_cmp(&cost(b)).then((a.view != present).cmp(&(b.view != present))));
    least.map_or(present, |c| c.view)
}
