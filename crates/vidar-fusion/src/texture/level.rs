//! Differences of colour at seams, spread over the charts (Waechter, Moehrle & Goesele 2014, section 4.1).
//!
//! A vertex at a seam has a colour in each chart there. Each vertex of each chart gets a correction; those of one place are to make its
//! colours equal, neighbours in a chart are to have the same. The sum of squares is minimised by Gauss–Seidel steps, first
//! with one correction per chart.

use super::charts::{Atlas, Chart};
use vidar_core::Image;

/// Colour of a vertex in its view, 0…255.
pub(super) type VertexColor = [f32; 3];

/// Weight of equal colours at a seam, against 1 for an edge of a chart.
const SEAM_WEIGHT: f32 = 1.0;
/// Weight of no correction: keeps the brightness of the whole.
const STAY_WEIGHT: f32 = 1e-3;
/// Steps over all vertices: the rest of a seam is then below what is seen.
const STEPS: usize = 60;
/// Texels around a triangle that are corrected with it.
const REACH: f32 = 3.0;

/// The correction of each vertex.
pub(super) fn corrections(
    triangles: &[[u32; 3]],
    origins: &[u32],
    colors: &[VertexColor],
) -> Vec<VertexColor> {
    let links = Links::new(triangles, origins);
    let mut correction = vec![[0.0f32; 3]; origins.len()];
    let chart_of = components(triangles, origins.len());
    by_chart(&links, &chart_of, colors, &mut correction);
    for _ in 0..STEPS {
        for at in 0..origins.len() {
            let mut weight = STAY_WEIGHT;
            let mut sum = [0.0; 3];
            let edges = links.edges.of(at).iter().map(|&other| (other as usize, 1.0, [0.0; 3]));
            let seams = links.seams.of(at).iter().map(|&other| {
                let other = other as usize;
                (other, SEAM_WEIGHT, [0, 1, 2].map(|c| colors[other][c] - colors[at][c]))
            });
            for (other, w, difference) in edges.chain(seams) {
                weight += w;
                (0..3).for_each(|c| sum[c] += w * (correction[other][c] + difference[c]));
            }
            correction[at] = sum.map(|s| s / weight);
        }
    }
    correction
}

/// Sets the corrections of each chart to what makes its seams equal on average.
fn by_chart(links: &Links, chart_of: &[u32], colors: &[VertexColor], correction: &mut [VertexColor]) {
    let charts = chart_of.iter().max().map_or(0, |c| *c as usize + 1);
    let mut pairs = Vec::new();
    let mut size = vec![0.0f32; charts];
    for (at, &chart) in chart_of.iter().enumerate() {
        size[chart as usize] += 1.0;
        pairs.extend(links.seams.of(at).iter().map(|&other| (chart, at as u32, other)));
    }
    pairs.sort_unstable();
    let mut offset = vec![[0.0f32; 3]; charts];
    for _ in 0..STEPS {
        for of_chart in pairs.chunk_by(|a, b| a.0 == b.0) {
            let chart = of_chart[0].0 as usize;
            let mut weight = STAY_WEIGHT * size[chart];
            let mut sum = [0.0; 3];
            for &(_, at, other) in of_chart {
                let (at, other) = (at as usize, other as usize);
                weight += 1.0;
                let of_other = offset[chart_of[other] as usize];
                (0..3).for_each(|c| sum[c] += of_other[c] + colors[other][c] - colors[at][c]);
            }
            offset[chart] = sum.map(|s| s / weight);
        }
    }
    for (correction, chart) in correction.iter_mut().zip(chart_of) {
        *correction = offset[*chart as usize];
    }
}

/// The number of each vertex's connected component; vertices of a chart are connected, and of no other.
fn components(triangles: &[[u32; 3]], vertices: usize) -> Vec<u32> {
    fn root(parent: &mut [u32], mut at: u32) -> u32 {
        while parent[at as usize] != at {
            parent[at as usize] = parent[parent[at as usize] as usize];
            at = parent[at as usize];
        }
        at
    }
    let mut parent: Vec<u32> = (0..vertices as u32).collect();
    for t in triangles {
        for other in &t[1..] {
            let (a, b) = (root(&mut parent, t[0]), root(&mut parent, *other));
            let (low, high) = (a.min(b), a.max(b));
            parent[high as usize] = low;
        }
    }
    // Roots come before the others, so their numbers are known in time.
    let mut numbers = vec![0; vertices];
    let mut next = 0;
    for at in 0..vertices as u32 {
        let root = root(&mut parent, at);
        numbers[at as usize] = if root == at {
            next += 1;
            next - 1
        } else {
            numbers[root as usize]
        };
    }
    numbers
}

/// Lists of vertices by vertex.
struct Lists {
    starts: Vec<u32>,
    items: Vec<u32>,
}

impl Lists {
    /// From pairs (vertex, item).
    fn new(mut pairs: Vec<[u32; 2]>, vertices: usize) -> Self {
        pairs.sort_unstable();
        pairs.dedup();
        let mut starts = vec![0u32; vertices + 1];
        pairs.iter().for_each(|p| starts[p[0] as usize + 1] += 1);
        (0..vertices).for_each(|i| starts[i + 1] += starts[i]);
        Self { starts, items: pairs.iter().map(|p| p[1]).collect() }
    }

    fn of(&self, vertex: usize) -> &[u32] {
        &self.items[self.starts[vertex] as usize..self.starts[vertex + 1] as usize]
    }
}

/// Which vertices are linked: by an edge of a chart, and as one place in several charts.
struct Links {
    edges: Lists,
    seams: Lists,
}

impl Links {
    fn new(triangles: &[[u32; 3]], origins: &[u32]) -> Self {
        let around = |t: &[u32; 3]| {
            let [a, b, c] = *t;
            [[a, b], [b, a], [b, c], [c, b], [c, a], [a, c]]
        };
        let edges = Lists::new(triangles.iter().flat_map(around).collect(), origins.len());
        let mut by_origin: Vec<u32> = (0..origins.len() as u32).collect();
        by_origin.sort_unstable_by_key(|&at| (origins[at as usize], at));
        let mut pairs = Vec::new();
        for same in by_origin.chunk_by(|a, b| origins[*a as usize] == origins[*b as usize]) {
            for &a in same {
                pairs.extend(same.iter().filter(|b| **b != a).map(|&b| [a, b]));
            }
        }
        Self { edges, seams: Lists::new(pairs, origins.len()) }
    }
}

/// Adds the corrections to the texels of the charts.
pub(super) fn correct(atlas: &mut Atlas, corrections: &[VertexColor]) {
    let mut texture = std::mem::replace(&mut atlas.texture, Image::filled(1, 1, [0; 3]));
    let mut sum = [0u64; 3];
    let mut is_used = vec![false; texture.data().len()];
    let width = texture.width();
    for chart in &atlas.charts {
        let field = field(atlas, chart, corrections);
        for row in 0..chart.texels[1] {
            for column in 0..chart.texels[0] {
                let at = (chart.place[1] + row) * width + chart.place[0] + column;
                let texel = &mut texture.data_mut()[at];
                let more = field[row * chart.texels[0] + column].unwrap_or_default();
                *texel = [0, 1, 2].map(|c| (f32::from(texel[c]) + more[c]).round() as u8);
                (0..3).for_each(|c| sum[c] += u64::from(texel[c]));
                is_used[at] = true;
            }
        }
    }
    // Between the charts the mean colour, so that smaller levels of a mipmap have no dark seams.
    let count = is_used.iter().filter(|u| **u).count().max(1) as u64;
    let mean = sum.map(|s| (s / count) as u8);
    for (texel, _) in texture.data_mut().iter_mut().zip(&is_used).filter(|(_, used)| !**used) {
        *texel = mean;
    }
    atlas.texture = texture;
}

/// The correction at each texel of a chart: interpolated in triangles, continued around them.
fn field(atlas: &Atlas, chart: &Chart, corrections: &[VertexColor]) -> Vec<Option<VertexColor>> {
    let [width, height] = chart.texels;
    let mut field = vec![None; width * height];
    // Triangles first; what lies beside one may lie in another.
    for reach in [0.0, REACH] {
        for triangle in &atlas.triangles[chart.triangles.clone()] {
            let [a, b, c] = triangle.map(|v| {
                let [x, y] = atlas.texel(chart, v as usize);
                [x - chart.place[0] as f32 - 0.5, y - chart.place[1] as f32 - 0.5]
            });
            let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
            let span = |axis: usize, size: usize| {
                let low = a[axis].min(b[axis]).min(c[axis]) - reach;
                let high = a[axis].max(b[axis]).max(c[axis]) + reach;
                // `as` saturates at 0.
                low.ceil() as usize..(high.floor().max(-1.0) + 1.0).min(size as f32) as usize
            };
            for row in span(1, height) {
                for column in span(0, width) {
                    let known = &mut field[row * width + column];
                    if known.is_some() {
                        continue;
                    }
                    let (x, y) = (column as f32, row as f32);
                    let wa = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area;
                    let wb = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area;
                    let weights = [wa, wb, 1.0 - wa - wb];
                    if reach == 0.0 && weights.iter().any(|w| !(*w >= 0.0)) {
                        continue;
                    }
                    let inside = weights.map(|w| if w.is_finite() { w.clamp(0.0, 1.0) } else { 1.0 });
                    let total: f32 = inside.iter().sum();
                    let of = |c: usize| {
                        let parts = triangle.iter().zip(inside);
                        parts.map(|(v, w)| w * corrections[*v as usize][c]).sum::<f32>() / total
                    };
                    *known = Some([of(0), of(1), of(2)]);
                }
            }
        }
    }
    field
}
