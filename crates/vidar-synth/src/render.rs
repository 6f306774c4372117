//! Pictures and depth of a world by casting rays.
//!
//! Rays of one pixel are spread over the exposure (motion blur) and over the pixel's area (smooth silhouettes);
//! textures are read with the ray's footprint. Depth is that of the pixel's centre at the middle of the exposure.

use crate::error::SynthError;
use crate::world::{Hit, TileBounds, TileHits, World};
use nalgebra::{Matrix3, Vector2, Vector3};
use rayon::prelude::*;
use vidar_core::{CameraModel, FrameImage, Image, MetricDepth, Se3};

/// Columns and rows of a tile, whose rays are cast together from one pose.
pub(crate) const TILE: [usize; 2] = [8, 8];

/// Tiles of a rolling shutter: rows of a tile share a pose, which is off by half a row's time at most. At 30 ms for
/// 480 rows, 3 rad/s and a focal length of 490 px that is 0.05 px.
pub(crate) const ROLLING_TILE: [usize; 2] = [32, 2];

/// The directions (z = 1) into which a camera's pixels look, for each of a set of places within the pixel.
pub(crate) struct RayTable {
    width: usize,
    height: usize,
    /// Columns and rows of a tile.
    tile: [usize; 2],
    samples: Vec<Sample>,
    /// Angle between neighbouring pixels near the axis, rad.
    pixel_angle: f64,
}

/// The rays of one place within the pixel.
struct Sample {
    /// Per pixel, x and y at z = 1; NaN where the camera model does not hold.
    rays: Vec<[f64; 2]>,
    /// Bounds of each tile's rays, row by row of tiles.
    tiles: Vec<TileBounds>,
}

impl RayTable {
    /// A table of `samples` places per pixel; the middle one is the pixel's centre.
    pub(crate) fn new(camera: &CameraModel, samples: usize) -> Self {
        Self::with_tiles(camera, samples, TILE)
    }

    /// As [`RayTable::new`], with tiles of `tile` columns and rows.
    pub(crate) fn with_tiles(camera: &CameraModel, samples: usize, tile: [usize; 2]) -> Self {
        Self::shifted(camera, samples, tile, |_| Vector2::zeros())
    }

    /// As [`RayTable::with_tiles`], of a camera whose picture is shifted by so many pixels in a row.
    pub(crate) fn shifted(
        camera: &CameraModel,
        samples: usize,
        tile: [usize; 2],
        shift_px: impl Fn(usize) -> Vector2<f64>,
    ) -> Self {
        let (width, height) = (camera.width(), camera.height());
        let shifts: Vec<Vector2<f64>> = (0..height).map(shift_px).collect();
        let samples = (0..samples)
            .map(|s| {
                let [dx, dy] = place_in_pixel(s, samples);
                let ray = |i: usize| {
                    let pixel = Vector2::new((i % width) as f64 + dx, (i / width) as f64 + dy);
                    camera
                        .unproject(&(pixel - shifts[i / width]))
                        .map_or([f64::NAN; 2], |r| [r.x / r.z, r.y / r.z])
                };
                let rays: Vec<[f64; 2]> = (0..width * height).into_par_iter().map(ray).collect();
                let columns = width.div_ceil(tile[0]);
                let mut tiles = vec![TileBounds::EMPTY; columns * height.div_ceil(tile[1])];
                for (i, ray) in rays.iter().enumerate() {
                    tiles[(i / width / tile[1]) * columns + (i % width) / tile[0]].add(*ray);
                }
                Sample { rays, tiles }
            })
            .collect();
        Self { width, height, tile, samples, pixel_angle: 1.0 / camera.intrinsics().fx }
    }

    /// The sample whose place is the pixel's centre.
    pub(crate) fn centre(&self) -> usize {
        self.samples.len() / 2
    }

    /// Middle row of band `band` of tiles; bands are numbered from the top.
    pub(crate) fn middle_row(&self, band: usize) -> f64 {
        let first = band * self.tile[1];
        let last = (first + self.tile[1]).min(self.height) - 1;
        0.5 * (first + last) as f64
    }
}

/// Sample `s` of `n` within the pixel, by the R2 sequence (Roberts 2018) shifted so that the middle one is the centre.
fn place_in_pixel(s: usize, n: usize) -> [f64; 2] {
    let k = s as f64 - (n / 2) as f64;
    [0.754_877_666_246_69, 0.569_840_290_998_05].map(|a| {
        let x = k * a;
        x - x.round()
    })
}

/// Radiance and z-depth of one frame.
pub(crate) struct Exposed {
    /// Mean radiance over the exposure, 0…1.
    pub radiance: Vec<f32>,
    /// z-depth of the pixel's centre at the middle of the exposure, m; NaN where there is none.
    pub depth: Vec<f32>,
}

/// Renders the frame whose sample `s` of band `b` of rows is taken from pose `world_from_camera(s, b)`.
pub(crate) fn expose(
    world: &World,
    rays: &RayTable,
    world_from_camera: impl Fn(usize, usize) -> Se3 + Sync,
) -> Exposed {
    let of_channels = expose_hits(world, rays, world_from_camera, |_, radiance| [radiance]);
    Exposed { radiance: of_channels.radiance.into_flattened(), depth: of_channels.depth }
}

/// As [`Exposed`], with several channels.
pub(crate) struct ExposedChannels<const C: usize> {
    /// Mean radiance over the exposure, 0…1 for grey surfaces.
    pub radiance: Vec<[f32; C]>,
    /// z-depth of the pixel's centre at the middle of the exposure, m; NaN where there is none.
    pub depth: Vec<f32>,
}

/// As [`expose`]; `colour` makes channels of the radiance at a hit.
pub(crate) fn expose_hits<const C: usize>(
    world: &World,
    rays: &RayTable,
    world_from_camera: impl Fn(usize, usize) -> Se3 + Sync,
    colour: impl Fn(&Hit, f32) -> [f32; C] + Sync,
) -> ExposedChannels<C> {
    let n = rays.width * rays.height;
    let mut radiance = vec![[0.0_f32; C]; n];
    let mut depth = vec![f32::NAN; n];
    let share = 1.0 / rays.samples.len() as f32;
    let band = rays.tile[1] * rays.width;
    let bands = radiance.par_chunks_mut(band).zip(depth.par_chunks_mut(band)).enumerate();
    bands.for_each(|(row, (radiance, depth))| {
        let mut hits = TileHits::default();
        for s in 0..rays.samples.len() {
            let eye = Eye::new(&world_from_camera(s, row));
            let is_centre = s == rays.centre();
            eye.cast_band(world, rays, s, row, &mut hits, |hits, ray, pixel| {
                let Some(hit) = world.tile_hit(hits, ray, &eye.origin) else { return };
                let footprint = footprint_m(&hit.normal, &hits.directions[ray], hit.t, rays.pixel_angle);
                let channels = colour(&hit, world.radiance(&hit, footprint));
                for (sum, channel) in radiance[pixel].iter_mut().zip(channels) {
                    *sum += share * channel;
                }
                if is_centre {
                    depth[pixel] = hit.t as f32;
                }
            });
        }
    });
    ExposedChannels { radiance, depth }
}

/// z-depth at the pixel centres from one pose, m; NaN where there is none.
pub(crate) fn depth_image(world: &World, rays: &RayTable, world_from_camera: &Se3) -> Image<f32> {
    let eye = Eye::new(world_from_camera);
    let mut depth = Image::filled(rays.width, rays.height, f32::NAN);
    let bands = depth.data_mut().par_chunks_mut(rays.tile[1] * rays.width).enumerate();
    bands.for_each(|(row, depth)| {
        eye.cast_band(world, rays, rays.centre(), row, &mut TileHits::default(), |hits, ray, pixel| {
            if let Some(z) = World::tile_depth(hits, ray) {
                depth[pixel] = z as f32;
            }
        });
    });
    depth
}

/// A camera's place and axes in the world.
struct Eye {
    origin: Vector3<f64>,
    rotation: Matrix3<f64>,
    axes: [Vector3<f64>; 3],
}

impl Eye {
    fn new(world_from_camera: &Se3) -> Self {
        let rotation = world_from_camera.rotation.matrix();
        let axes = [0, 1, 2].map(|k| rotation.column(k).into_owned());
        Self { origin: world_from_camera.translation, rotation, axes }
    }

    /// Casts sample `sample` of a row of tiles and reports each ray and its pixel (counted from the band's first).
    fn cast_band(
        &self,
        world: &World,
        rays: &RayTable,
        sample: usize,
        band: usize,
        hits: &mut TileHits,
        mut pixel_of: impl FnMut(&TileHits, usize, usize),
    ) {
        let Sample { rays: table, tiles } = &rays.samples[sample];
        let [across, down] = rays.tile;
        let columns = rays.width.div_ceil(across);
        let rows = down * band..(down * (band + 1)).min(rays.height);
        for column in 0..columns {
            let xs = across * column..(across * (column + 1)).min(rays.width);
            let bounds = &tiles[band * columns + column];
            hits.directions.clear();
            for y in rows.clone() {
                let of_row = table[y * rays.width..][xs.clone()].iter();
                hits.directions.extend(of_row.map(|[x, y]| self.rotation * Vector3::new(*x, *y, 1.0)));
            }
            world.cast_tile(bounds, &self.origin, &self.axes, hits);
            for ray in 0..hits.directions.len() {
                let (x, y) = (xs.start + ray % xs.len(), ray / xs.len());
                // A ray that is none has no direction.
                if !hits.directions[ray].x.is_nan() {
                    pixel_of(hits, ray, y * rays.width + x);
                }
            }
        }
    }
}

/// Width of the surface that a pixel sees: between the axes of its ellipse, halfway from their mean to the longer one.
///
/// The shorter axis would alias at grazing angles, the longer one would blur floors away.
fn footprint_m(normal: &Vector3<f64>, direction: &Vector3<f64>, t: f64, pixel_angle: f64) -> f64 {
    let length = direction.norm();
    let cosine = (normal.dot(direction).abs() / length).max(0.05);
    let root = cosine.sqrt();
    pixel_angle * t * length / (root * root.sqrt())
}

/// A place to look from.
#[derive(Clone, Debug)]
pub struct SynthView {
    /// Pose of the camera.
    pub world_from_camera: Se3,
    /// How the camera projects, any model.
    pub camera: CameraModel,
}

/// What is seen from a place.
#[derive(Clone, Debug)]
pub struct RenderedView {
    /// The picture without noise, 8-bit grey, exposure 1.
    pub image: FrameImage,
    /// Exact z-depth at the pixel centres, m; NaN where a pixel sees nothing.
    pub depth: MetricDepth,
}

/// Pictures and exact depth of `world` from arbitrary places, without noise or blur, `samples` rays per pixel.
///
/// Deterministic, and parallel over pixels.
///
/// # Errors
/// `samples` outside 1…64.
pub fn render_views(
    world: &World,
    views: &[SynthView],
    samples: usize,
) -> Result<Vec<RenderedView>, SynthError> {
    if !(1..=64).contains(&samples) {
        let found = samples.to_string();
        return Err(SynthError::BadConfig { key: "samples", expected: "1 to 64", found });
    }
    let mut rendered = Vec::with_capacity(views.len());
    // Views mostly share one camera, whose rays need to be found only once.
    let mut known: Option<(&CameraModel, RayTable)> = None;
    for view in views {
        let rays = match known.take() {
            Some((camera, rays)) if *camera == view.camera => rays,
            _ => RayTable::new(&view.camera, samples),
        };
        rendered.push(render_view(world, view, &rays));
        known = Some((&view.camera, rays));
    }
    Ok(rendered)
}

fn render_view(world: &World, view: &SynthView, rays: &RayTable) -> RenderedView {
    let exposed = expose(world, rays, |_, _| view.world_from_camera);
    let (width, height) = (rays.width, rays.height);
    let image = Image::from_fn(width, height, |x, y| (exposed.radiance[y * width + x] * 255.0).round() as u8);
    let depth = Image::from_fn(width, height, |x, y| exposed.depth[y * width + x]);
    RenderedView { image: FrameImage::Gray8(image), depth: MetricDepth::new(depth) }
}
