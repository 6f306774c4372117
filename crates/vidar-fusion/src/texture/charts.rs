//! Charts, their places in the texture, and their pixels.

use super::select::NO_VIEW;
use super::{TextureCamera, pick};
use crate::render::Eye;
use rustc_hash::FxHashMap;
use vidar_core::{Image, TexturedMesh, TriangleMesh};

/// Pixels around a chart that are copied with it, so that interpolation at its border and two levels of mipmaps show its image.
const PADDING_PX: f32 = 3.0;
/// How much smaller charts become when they did not fit.
const SHRINK: f64 = 0.96;
/// No neighbour.
const NO_TRIANGLE: u32 = u32::MAX;

/// The triangle beyond each edge, [`NO_TRIANGLE`] where there is none; of more than two at an edge only pairs are neighbours.
pub(super) fn neighbours(mesh: &TriangleMesh) -> Vec<[u32; 3]> {
    let mut edges: Vec<([u32; 2], u32, u8)> = Vec::with_capacity(3 * mesh.triangles.len());
    for (at, t) in mesh.triangles.iter().enumerate() {
        for side in 0..3 {
            let (a, b) = (t[side], t[(side + 1) % 3]);
            edges.push(([a.min(b), a.max(b)], at as u32, side as u8));
        }
    }
    edges.sort_unstable();
    let mut neighbours = vec![[NO_TRIANGLE; 3]; mesh.triangles.len()];
    let mut at = 0;
    while at + 1 < edges.len() {
        let ((edge, one, i), (other_edge, other, j)) = (edges[at], edges[at + 1]);
        if edge == other_edge {
            neighbours[one as usize][i as usize] = other;
            neighbours[other as usize][j as usize] = one;
            at += 1;
        }
        at += 1;
    }
    neighbours
}

/// Connected triangles of one view.
pub(super) struct Chart {
    pub view: u32,
    /// Its triangles and vertices in those of the atlas.
    pub triangles: std::ops::Range<usize>,
    vertices: std::ops::Range<usize>,
    /// The rectangle of the image that it shows: first column and row, columns and rows.
    first: [f32; 2],
    size: [f32; 2],
    /// Its first texel, and texels along both axes.
    pub place: [usize; 2],
    pub texels: [usize; 2],
}

/// All charts in one texture.
pub(super) struct Atlas {
    pub charts: Vec<Chart>,
    /// Triangles of vertices of the atlas, chart by chart.
    pub triangles: Vec<[u32; 3]>,
    /// The mesh's vertex that each vertex comes from.
    pub origins: Vec<u32>,
    /// Where each vertex lies in its image, pixels.
    pixels: Vec<[f32; 2]>,
    /// Texels per pixel.
    pub scale: f64,
    pub texture: Image<[u8; 3]>,
}

impl Atlas {
    /// Charts of triangles with one label that share edges, packed into a texture of at most `max_px` along an edge.
    pub fn new(
        mesh: &TriangleMesh,
        cameras: &[TextureCamera],
        labels: &[u32],
        neighbours: &[[u32; 3]],
        max_px: usize,
    ) -> Self {
        let eyes: Vec<Eye> = cameras.iter().map(|c| Eye::new(&c.world_from_camera, &c.intrinsics)).collect();
        let mut atlas = Self {
            charts: Vec::new(),
            triangles: Vec::new(),
            origins: Vec::new(),
            pixels: Vec::new(),
            scale: 1.0,
            texture: Image::filled(1, 1, [0; 3]),
        };
        let mut is_taken: Vec<bool> = labels.iter().map(|l| *l == NO_VIEW).collect();
        for start in 0..labels.len() {
            if !std::mem::replace(&mut is_taken[start], true) {
                let mut members = vec![start as u32];
                let mut next = 0;
                while let Some(&member) = members.get(next) {
                    next += 1;
                    for &n in &neighbours[member as usize] {
                        if labels.get(n as usize) == Some(&labels[start]) && !is_taken[n as usize] {
                            is_taken[n as usize] = true;
                            members.push(n);
                        }
                    }
                }
                atlas.add_chart(mesh, &members, labels[start], &eyes[labels[start] as usize]);
            }
        }
        atlas.pack(max_px);
        atlas
    }

    fn add_chart(&mut self, mesh: &TriangleMesh, members: &[u32], view: u32, eye: &Eye) {
        let (first_triangle, first_vertex) = (self.triangles.len(), self.origins.len());
        let mut new: FxHashMap<u32, u32> = FxHashMap::default();
        for &member in members {
            let triangle = mesh.triangles[member as usize].map(|origin| {
                *new.entry(origin).or_insert_with(|| {
                    self.origins.push(origin);
                    // Every corner of a triangle is seen by its view.
                    let [x, y, _] = eye.project(&mesh.positions[origin as usize]).unwrap_or_default();
                    self.pixels.push([x, y]);
                    self.origins.len() as u32 - 1
                })
            });
            self.triangles.push(triangle);
        }
        let pixels = &self.pixels[first_vertex..];
        let low =
            [0, 1].map(|a| pixels.iter().map(|p| p[a]).fold(f32::INFINITY, f32::min).floor() - PADDING_PX);
        let high =
            [0, 1].map(|a| pixels.iter().map(|p| p[a]).fold(f32::NEG_INFINITY, f32::max).ceil() + PADDING_PX);
        self.charts.push(Chart {
            view,
            triangles: first_triangle..self.triangles.len(),
            vertices: first_vertex..self.origins.len(),
            first: low,
            size: [0, 1].map(|a| high[a] - low[a] + 1.0),
            place: [0; 2],
            texels: [0; 2],
        });
    }

    /// Finds a place for each chart, on shelves from tall to low (next fit by decreasing height, Coffman et al. 1980).
    fn pack(&mut self, max_px: usize) {
        let mut order: Vec<usize> = (0..self.charts.len()).collect();
        let height = |c: &Chart| (c.size[1] as u32, c.size[0] as u32);
        order.sort_by_key(|&i| (std::cmp::Reverse(height(&self.charts[i])), i));
        let mut scale = 1.0;
        let (width, height) = loop {
            let mut area = 0;
            let mut widest = 1;
            for chart in &mut self.charts {
                chart.texels = chart.size.map(|s| ((f64::from(s) * scale).ceil() as usize).max(1));
                area += chart.texels[0] * chart.texels[1];
                widest = widest.max(chart.texels[0]);
            }
            let width = (((area as f64 * 1.1).sqrt() as usize).max(widest).next_multiple_of(4)).min(max_px);
            let height = self.place(&order, width).next_multiple_of(4);
            if height <= max_px && widest <= width {
                break (width, height);
            }
            // Charts of a few pixels do not become smaller for ever: below a texel each they fit or nothing does.
            if scale < 1e-3 {
                self.drop_charts();
                break (4, 4);
            }
            scale *= SHRINK;
        };
        self.scale = scale;
        self.texture = Image::filled(width, height, [0; 3]);
    }

    fn place(&mut self, order: &[usize], width: usize) -> usize {
        let (mut x, mut y, mut shelf) = (0, 0, 0);
        for &at in order {
            let chart = &mut self.charts[at];
            let [w, h] = chart.texels;
            if x + w > width {
                (x, y, shelf) = (0, y + shelf, 0);
            }
            chart.place = [x, y];
            x += w;
            shelf = shelf.max(h);
        }
        y + shelf
    }

    fn drop_charts(&mut self) {
        self.charts.clear();
        self.triangles.clear();
        self.origins.clear();
        self.pixels.clear();
    }

    /// Whether a chart shows the view.
    pub fn shows(&self, view: u32) -> bool {
        self.charts.iter().any(|c| c.view == view)
    }

    /// Copies the charts of a view from its image.
    pub fn paint(&mut self, view: u32, image: &Image<[u8; 3]>) {
        // As many samples along a texel as it has pixels.
        let samples = (1.0 / self.scale - 1e-9).ceil().max(1.0) as usize;
        for chart in self.charts.iter().filter(|c| c.view == view) {
            for row in 0..chart.texels[1] {
                for column in 0..chart.texels[0] {
                    let mut sum = [0.0; 3];
                    for i in 0..samples * samples {
                        let part = |k: usize| (k as f32 + 0.5) / samples as f32;
                        let x = chart.pixel(0, column as f32 + part(i % samples), self.scale);
                        let y = chart.pixel(1, row as f32 + part(i / samples), self.scale);
                        let color = bilinear(image, x, y);
                        (0..3).for_each(|c| sum[c] += color[c]);
                    }
                    let texel = sum.map(|s| (s / (samples * samples) as f32).round() as u8);
                    let [x, y] = chart.place;
                    let width = self.texture.width();
                    self.texture.data_mut()[(y + row) * width + x + column] = texel;
                }
            }
        }
    }

    /// Reads the colours of a view's vertices: means of three by three pixels.
    pub fn sample(&self, view: u32, image: &Image<[u8; 3]>, colors: &mut [[f32; 3]]) {
        for chart in self.charts.iter().filter(|c| c.view == view) {
            for vertex in chart.vertices.clone() {
                let [x, y] = self.pixels[vertex];
                let mut sum = [0.0; 3];
                for i in 0..9 {
                    let color = bilinear(image, x + (i % 3) as f32 - 1.0, y + (i / 3) as f32 - 1.0);
                    (0..3).for_each(|c| sum[c] += color[c] / 9.0);
                }
                colors[vertex] = sum;
            }
        }
    }

    /// Where a vertex of a chart lies in the texture, texels; (0, 0) is the corner.
    pub fn texel(&self, chart: &Chart, vertex: usize) -> [f32; 2] {
        [0, 1].map(|a| {
            (self.pixels[vertex][a] - chart.first[a] + 0.5) * self.scale as f32 + chart.place[a] as f32
        })
    }

    /// The mesh with coordinates in the texture.
    pub fn into_mesh(self, mesh: &TriangleMesh, rest: TriangleMesh) -> TexturedMesh {
        let size = [self.texture.width() as f32, self.texture.height() as f32];
        let mut uvs = vec![[0.0; 2]; self.origins.len()];
        for chart in &self.charts {
            for vertex in chart.vertices.clone() {
                let texel = self.texel(chart, vertex);
                uvs[vertex] = [texel[0] / size[0], texel[1] / size[1]];
            }
        }
        let textured = TriangleMesh {
            positions: pick(&mesh.positions, &self.origins),
            normals: pick(&mesh.normals, &self.origins),
            colors: Vec::new(),
            confidences: pick(&mesh.confidences, &self.origins),
            triangles: self.triangles,
        };
        TexturedMesh { textured, uvs, texture: self.texture, rest }
    }
}

impl Chart {
    /// The column (axis 0) or row of the image at a place in the chart's texels, whose first corner is 0.
    fn pixel(&self, axis: usize, texel: f32, scale: f64) -> f32 {
        texel / scale as f32 - 0.5 + self.first[axis]
    }
}

/// The colour between four pixels; beyond the border that of the border.
fn bilinear(image: &Image<[u8; 3]>, x: f32, y: f32) -> [f32; 3] {
    let (right, bottom) = (image.width() - 1, image.height() - 1);
    let (x, y) = (x.clamp(0.0, right as f32), y.clamp(0.0, bottom as f32));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(right), (y0 + 1).min(bottom));
    let (fx, fy) = (x - x0 as f32, y - y0 as f32);
    [0, 1, 2].map(|c| {
        let at = |x: usize, y: usize| f32::from(image[(x, y)][c]);
        let row = |y: usize| at(x0, y) * (1.0 - fx) + at(x1, y) * fx;
        row(y0) * (1.0 - fy) + row(y1) * fy
    })
}
