//! A texture for a mesh, from the images of its views.
//!
//! Each triangle takes its colours from one view ([`select`]); connected triangles of one view are a chart, whose texture is a
//! rectangle of that view's image, so nothing is resampled unless the texture would be too large ([`charts`]); differences of
//! colour at the seams between charts are spread over them ([`level`]). This is the labelling of Lempitsky & Ivanov (CVPR 2007)
//! with the levelling of Waechter, Moehrle & Goesele (ECCV 2014), its labels chosen greedily.
//!
//! Images are asked for one at a time and twice, so that memory holds one of them, the mesh and the texture.

mod charts;
mod level;
mod select;

use crate::FusionError;
use charts::Atlas;
use level::{VertexColor, correct, corrections};
use select::{Candidates, NO_VIEW, labels};
use serde::{Deserialize, Serialize};
use vidar_core::{Image, Pinhole, Se3, TexturedMesh, TriangleMesh};

/// Settings of a texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TextureConfig {
    /// Most texels along an edge of the texture, [`Self::MIN_PX`] to [`Self::MAX_PX`]. Where the images' own pixels do not fit,
    /// they are made smaller.
    pub max_px: usize,
}

impl Default for TextureConfig {
    fn default() -> Self {
        Self { max_px: 8192 }
    }
}

impl TextureConfig {
    /// Smallest edge that may be asked for.
    pub const MIN_PX: usize = 64;
    /// Largest edge that may be asked for: what WebGL programs can be expected to show.
    pub const MAX_PX: usize = 16_384;

    /// Checks the edge against its range.
    pub fn validate(&self) -> Result<(), FusionError> {
        if (Self::MIN_PX..=Self::MAX_PX).contains(&self.max_px) {
            return Ok(());
        }
        Err(FusionError::BadTextureSize { min: Self::MIN_PX, max: Self::MAX_PX, found: self.max_px })
    }
}

/// Where an image was taken.
#[derive(Clone, Debug, PartialEq)]
pub struct TextureCamera {
    /// The camera's pose, metres.
    pub world_from_camera: Se3,
    /// The camera of the undistorted image.
    pub intrinsics: Pinhole,
}

/// What a view shows.
#[derive(Clone, Debug, PartialEq)]
pub struct TextureImage {
    /// sRGB, of the size of the camera's intrinsics.
    pub color: Image<[u8; 3]>,
    /// The view's own z-depth, metres, NaN where there is none, of any size; it tells what stands in front of the mesh and is
    /// not in it. `None` where a view has no depth.
    pub depth: Option<Image<f32>>,
}

/// What became of the mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TextureReport {
    /// Triangles with texture.
    pub textured_triangles: u64,
    /// Triangles of the mesh.
    pub triangles: u64,
    /// Connected parts that show one image each.
    pub charts: u64,
    /// Texels per image pixel, at most 1.
    pub scale: f64,
    /// Columns of the texture.
    pub width_px: u32,
    /// Rows of the texture.
    pub height_px: u32,
}

/// Textures `mesh` from the views at `cameras`; `image` gives that of camera i and is called twice for each.
///
/// Triangles that no view shows keep their vertices' colours ([`TexturedMesh::rest`]). The same bits for any number of threads.
///
/// # Errors
/// A configuration out of range, a mesh whose indices do not fit, an image of another size than its camera's, and what `image`
/// returns.
pub fn texture_mesh<E: From<FusionError>>(
    mesh: &TriangleMesh,
    cameras: &[TextureCamera],
    mut image: impl FnMut(usize) -> Result<TextureImage, E>,
    config: &TextureConfig,
) -> Result<(TexturedMesh, TextureReport), E> {
    config.validate()?;
    if !mesh.is_consistent() {
        return Err(FusionError::BadMesh { vertices: mesh.positions.len() }.into());
    }
    let mut image = |view: usize| {
        let shown = image(view)?;
        let (k, found) = (&cameras[view].intrinsics, (shown.color.width(), shown.color.height()));
        if found != (k.width, k.height) {
            let expected = (k.width, k.height);
            return Err(E::from(FusionError::ImageSize { view, found, expected }));
        }
        Ok(shown)
    };
    let mut candidates = Candidates::new(mesh);
    for (view, camera) in cameras.iter().enumerate() {
        candidates.add(view as u32, camera, &image(view)?);
    }
    let neighbours = charts::neighbours(mesh);
    let labels = labels(candidates, &neighbours, cameras.len());
    let mut atlas = Atlas::new(mesh, cameras, &labels, &neighbours, config.max_px);
    drop(neighbours);
    let mut colors = vec![VertexColor::default(); atlas.origins.len()];
    for view in 0..cameras.len() {
        if atlas.shows(view as u32) {
            let shown = image(view)?;
            atlas.paint(view as u32, &shown.color);
            atlas.sample(view as u32, &shown.color, &mut colors);
        }
    }
    let corrections = corrections(&atlas.triangles, &atlas.origins, &colors);
    correct(&mut atlas, &corrections);
    let report = TextureReport {
        textured_triangles: atlas.triangles.len() as u64,
        triangles: mesh.triangles.len() as u64,
        charts: atlas.charts.len() as u64,
        scale: atlas.scale,
        width_px: atlas.texture.width() as u32,
        height_px: atlas.texture.height() as u32,
    };
    let rest = labels.iter().zip(&mesh.triangles).filter(|(label, _)| **label == NO_VIEW);
    let rest = part(mesh, rest.map(|(_, triangle)| *triangle));
    Ok((atlas.into_mesh(mesh, rest), report))
}

/// Some triangles of a mesh, with the vertices that they need.
fn part(mesh: &TriangleMesh, triangles: impl Iterator<Item = [u32; 3]>) -> TriangleMesh {
    let mut new = vec![u32::MAX; mesh.positions.len()];
    let mut old = Vec::new();
    let mut renumber = |i: u32| {
        let at = &mut new[i as usize];
        if *at == u32::MAX {
            *at = old.len() as u32;
            old.push(i);
        }
        *at
    };
    let triangles = triangles.map(|t| t.map(&mut renumber)).collect();
    let colors = pick(&mesh.colors, &old);
    TriangleMesh {
        positions: pick(&mesh.positions, &old),
        normals: pick(&mesh.normals, &old),
        colors,
        confidences: pick(&mesh.confidences, &old),
        triangles,
    }
}

/// The values at `indices`; none where there are none.
fn pick<T: Copy>(values: &[T], indices: &[u32]) -> Vec<T> {
    indices.iter().filter_map(|&i| values.get(i as usize).copied()).collect()
}
