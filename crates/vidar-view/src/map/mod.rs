//! Pictures of a map by a software rasteriser: no graphics card, no display, the same pixels everywhere.
//!
//! Triangles are scan-converted with exact integer edge functions (Pineda, "A parallel algorithm for polygon
//! rasterization", 1988) and a z-buffer into 3 × 3 samples per pixel; points are discs in space. The light sits at the
//! camera. Back faces are skipped or dimmed, as set in the camera, so that the inside of a closed room is
//! visible from outside. Bands of rows are drawn in parallel, each in the order of the triangles.

pub mod camera;
mod crease;
mod paint;
mod raster;

use crate::axes::{end_mark, start_mark};
use crate::canvas::{Area, Canvas, Pen, theme};
use crate::colormap::ColorMap;
use crate::size::{PictureSize, TypeScale};
use crate::text::{Align, TextStyle};
use crate::ticks::Ticks;
use crate::top_down::scale_bar;
use crate::{Picture, ViewError};
use camera::{MapCamera, Projection};
use raster::Lens;
use vidar_core::{PointCloud, Trajectory, TriangleMesh};

/// The surface to draw.
#[derive(Clone, Copy, Debug)]
pub enum MapSurface<'a> {
    /// Triangles.
    Mesh(&'a TriangleMesh),
    /// Points, as discs about as large as the distance between neighbours.
    Cloud(&'a PointCloud),
}

impl MapSurface<'_> {
    /// Positions of the vertices or points, metres, world.
    pub fn positions(&self) -> &[[f32; 3]] {
        match self {
            Self::Mesh(mesh) => &mesh.positions,
            Self::Cloud(cloud) => &cloud.positions,
        }
    }

    fn normals(&self) -> &[[f32; 3]] {
        match self {
            Self::Mesh(mesh) => &mesh.normals,
            Self::Cloud(cloud) => &cloud.normals,
        }
    }

    fn colors(&self) -> &[[u8; 3]] {
        match self {
            Self::Mesh(mesh) => &mesh.colors,
            Self::Cloud(cloud) => &cloud.colors,
        }
    }

    fn check(&self) -> Result<(), ViewError> {
        let (surface, consistent, triangles) = match self {
            Self::Mesh(mesh) => ("mesh", mesh.is_consistent(), mesh.triangles.len()),
            Self::Cloud(cloud) => ("cloud", cloud.is_consistent(), 0),
        };
        let vertices = self.positions().len();
        // Vertex indices are u32.
        if consistent && vertices <= u32::MAX as usize && triangles <= u32::MAX as usize {
            Ok(())
        } else {
            Err(ViewError::InconsistentSurface { surface, vertices, triangles })
        }
    }
}

/// Meaning of the colours.
#[derive(Clone, Copy, Debug)]
pub enum Shading<'a> {
    /// The surface's own colours; a light grey where it has none.
    Color,
    /// The direction of the normal in the world: red, green, blue for x, y, z.
    Normals,
    /// A value per vertex, with a colour scale in the picture. Values that are not finite are grey.
    Error {
        /// One value per vertex or point.
        values: &'a [f32],
        /// Values at the ends of the scale; beyond them the colour stays that of the end.
        range: (f32, f32),
        /// Name of the values, with the unit (`distance to reference [m]`).
        label: &'a str,
    },
}

/// Draws a map as seen by `camera`. A parallel view carries a scale bar, an error view its colour scale.
///
/// # Errors
/// [`ViewError::InconsistentSurface`], [`ViewError::WrongValueCount`], [`ViewError::BadCamera`].
pub fn render_map(
    surface: MapSurface<'_>,
    camera: &MapCamera,
    size: PictureSize,
    shading: Shading<'_>,
) -> Result<Picture, ViewError> {
    render_map_with_path(surface, camera, size, shading, None)
}

/// [`render_map`] with the path of a camera or body on top of the map, never hidden by it.
///
/// # Errors
/// As [`render_map`].
pub fn render_map_with_path(
    surface: MapSurface<'_>,
    camera: &MapCamera,
    size: PictureSize,
    shading: Shading<'_>,
    path: Option<&Trajectory>,
) -> Result<Picture, ViewError> {
    surface.check()?;
    if let Shading::Error { values, .. } = shading {
        let expected = surface.positions().len();
        if values.len() != expected {
            return Err(ViewError::WrongValueCount { expected, found: values.len() });
        }
    }
    let lens = Lens::new(camera, size.width(), size.height())?;
    let vertices = paint::painted(&surface, &lens, &shading);
    let frame = match surface {
        MapSurface::Mesh(mesh) => raster::draw_mesh(&lens, &vertices, &mesh.triangles),
        MapSurface::Cloud(cloud) => raster::draw_cloud(&lens, &vertices, paint::disc_radius_m(cloud)),
    };
    let picture = crease::darkened(frame, &lens);

    let mut canvas = Canvas::new(size, theme::PAPER);
    canvas.blit(&picture, 0, 0);
    let scale = size.type_scale();
    if let Some(path) = path {
        draw_path(&mut canvas, &lens, path, scale);
    }
    let area = Area { left: 0.0, top: 0.0, width: canvas.width(), height: canvas.height() };
    if let Projection::Orthographic { height_m } = camera.projection {
        scale_bar(&mut canvas, &area, size.height() as f64 / height_m, scale);
    }
    if let Shading::Error { range, label, .. } = shading {
        draw_error_scale(&mut canvas, range, label, scale);
    }
    Ok(canvas.into_picture())
}

/// The path with a pale halo, visible on dark and bright background.
fn draw_path(canvas: &mut Canvas, lens: &Lens, path: &Trajectory, scale: TypeScale) {
    let pixels: Vec<Option<(f64, f64)>> =
        path.poses().iter().map(|p| lens.picture_point(&p.world_from_body.translation)).collect();
    for (color, width) in [(theme::PAPER, 5.0), (theme::DATA[1], 2.5)] {
        for run in pixels.split(Option::is_none) {
            let run: Vec<_> = run.iter().copied().flatten().collect();
            canvas.polyline(&run, Pen::new(color, width * scale.unit));
        }
    }
    if let Some(last) = pixels.last().copied().flatten() {
        end_mark(canvas, last, theme::DATA[1], scale.unit);
    }
    if let Some(first) = pixels.first().copied().flatten() {
        start_mark(canvas, first, theme::DATA[1], scale.unit);
    }
}

fn draw_error_scale(canvas: &mut Canvas, range: (f32, f32), label: &str, scale: TypeScale) {
    let (low, high) = (f64::from(range.0), f64::from(range.1));
    let (line, unit) = (scale.line(), scale.unit);
    let style = TextStyle::new(scale.body, theme::INK);
    let width = (0.34 * canvas.width()).max(8.0 * line).min(canvas.width() - 3.0 * line);
    let label = style.fitted(label, width);
    let bar = Area { left: 1.6 * line, top: canvas.height() - 2.5 * line, width, height: 0.8 * line };
    let card = Area {
        left: bar.left - 1.0 * line,
        top: bar.top - 1.5 * line,
        width: bar.width + 2.0 * line,
        height: 3.8 * line,
    };
    canvas.veil(&card, theme::PAPER, 225);
    canvas.text((bar.left, bar.top - 0.75 * line), &label, Align::Start, &style);
    let columns = bar.width.round() as usize;
    for x in 0..columns {
        let color = ColorMap::Ember.color(x as f32 / (columns - 1).max(1) as f32);
        canvas.fill_area(&Area { left: (bar.left + x as f64).round(), width: 1.0, ..bar }, color);
    }
    canvas.outline(&bar, Pen::new(theme::FRAME, unit));
    let intervals = (width / (style.width_of("0.00") + 2.0 * line)).clamp(1.0, 6.0) as usize;
    let ticks = Ticks::between(low, high, intervals);
    for value in &ticks.values {
        let x = bar.left + (value - low) / (high - low) * bar.width;
        canvas.rule([(x, bar.bottom()), (x, bar.bottom() + 4.0 * unit)], Pen::new(theme::FRAME, unit));
        canvas.text((x, bar.bottom() + 4.0 * unit + 0.6 * line), &ticks.label(*value), Align::Middle, &style);
    }
}

#[cfg(test)]
mod tests;
