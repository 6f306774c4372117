//! A map to turn, to walk through and to measure in, inside one HTML file.
//!
//! [`encode_view`] simplifies surfaces to what a browser draws fluently, quantises them and packs them into JSON; the scripts
//! under `interactive/js` unpack and draw them with WebGL. Nothing is fetched, and without WebGL or scripts the page says so
//! and leaves its pictures to be looked at.
//!
//! - `grid`: cells of space: thinning of clouds, normals of points, values carried from samples to vertices.
//! - `simplify`: vertex clustering with quadric placement (Lindstrom 2000).
//! - `payload`: sixteen-bit positions, eight-bit values, indices as bytes.
//! - `page`: the controls as HTML.

mod grid;
pub(crate) mod page;
mod payload;
mod simplify;
mod thumbnail;

pub use thumbnail::{DepthThumbnail, depth_thumbnail};

use crate::ViewError;
use crate::colormap::ColorMap;
use nalgebra::Vector3;
use vidar_core::{Pinhole, PointCloud, Se3, Trajectory, TriangleMesh};

/// Triangles of all panes together. At about 21 bytes a triangle in the file this is 3.4 MB, and processors' own graphics draw
/// it in well under 16 ms; on a room of 100 m² an edge is about 4 cm long.
const MAX_TRIANGLES: usize = 160_000;
/// Points of all panes together, about 18 bytes each in the file.
const MAX_POINTS: usize = 90_000;
/// Poses of a path; a longer one is thinned evenly.
const MAX_PATH_POSES: usize = 1_500;

/// Maps side by side with one camera, and how they are shown at first.
#[derive(Clone, Debug)]
pub struct InteractiveView<'a> {
    /// The maps, all in one world.
    pub panes: Vec<Pane<'a>>,
    /// Up in that world, unit length.
    pub up: Vector3<f64>,
    /// Which panes are visible at first.
    pub shown: PanesShown,
    /// Colouring at first; that of the surface where a pane lacks it.
    pub coloring: Option<FieldKind>,
}

/// Which panes are visible before the reader chooses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PanesShown {
    /// The first one; the others on request.
    First,
    /// All, side by side.
    All,
}

/// A map and what belongs to it.
#[derive(Clone, Debug)]
pub struct Pane<'a> {
    /// Its name.
    pub name: String,
    /// Its surface, world, metres unless the scale says otherwise.
    pub mesh: Option<&'a TriangleMesh>,
    /// Its points.
    pub cloud: Option<&'a PointCloud>,
    /// Values by which it can be coloured.
    pub fields: Vec<Field<'a>>,
    /// Trajectories of the camera. The first one is the path that can be flown along.
    pub paths: Vec<PanePath<'a>>,
    /// Keyframes drawn as frusta.
    pub keyframes: Vec<PosedThumbnail>,
    /// What is known of its scale.
    pub scale: PaneScale,
}

/// What a length in a pane means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PaneScale {
    /// Metres, with the standard deviation of ln s where it is known.
    Metric {
        /// σ(ln s): the relative standard deviation of every length.
        log_std: Option<f64>,
    },
    /// Metres by measurement of the reference itself.
    Reference,
    /// An arbitrary unit.
    Arbitrary,
}

/// What a value on a surface is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FieldKind {
    /// Confidence, 0…1.
    Confidence,
    /// Distance to the reference, m.
    Error,
    /// Standard deviation of depth, m.
    Sigma,
    /// Distance to the surface of another pane, m.
    Difference,
}

impl FieldKind {
    /// All, in the order of the list that the page shows.
    pub const ALL: [Self; 4] = [Self::Confidence, Self::Error, Self::Sigma, Self::Difference];

    fn id(self) -> &'static str {
        match self {
            Self::Confidence => "confidence",
            Self::Error => "error",
            Self::Sigma => "sigma",
            Self::Difference => "difference",
        }
    }

    fn color_map(self) -> ColorMap {
        match self {
            Self::Confidence => ColorMap::Sea,
            Self::Error | Self::Sigma | Self::Difference => ColorMap::Ember,
        }
    }
}

/// Values of a kind on the surface of a pane, or why there are none.
#[derive(Clone, Debug)]
pub struct Field<'a> {
    /// What they are.
    pub kind: FieldKind,
    /// Name on the colour scale, with the unit (`distance to reference [m]`).
    pub label: String,
    /// The values.
    pub values: FieldValues<'a>,
}

/// Where values on a surface come from.
#[derive(Clone, Debug)]
pub enum FieldValues<'a> {
    /// Those that mesh and cloud carry themselves: only confidence.
    Own,
    /// Values at places in the world; each vertex takes the mean of those in its cell.
    Samples {
        /// Where.
        positions: &'a [[f32; 3]],
        /// One value each; those that are not finite are left out.
        values: &'a [f32],
        /// Values at the ends of the colour scale.
        range: (f32, f32),
    },
    /// There are none, for this reason, as an end of the sentence "not available: …".
    Missing(String),
}

/// Meaning of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathRole {
    /// Of the map.
    Estimate,
    /// Ground truth.
    Truth,
}

/// A trajectory of the camera in the world of the pane.
#[derive(Clone, Debug)]
pub struct PanePath<'a> {
    /// Its name.
    pub name: String,
    /// Its meaning.
    pub role: PathRole,
    /// `world_from_camera`.
    pub trajectory: &'a Trajectory,
}

/// A keyframe with small pictures.
#[derive(Clone, Debug)]
pub struct PosedThumbnail {
    /// Number of the frame in the recording.
    pub frame: u32,
    /// Time, ns.
    pub time_ns: i64,
    /// Its pose.
    pub world_from_camera: Se3,
    /// Its camera.
    pub intrinsics: Pinhole,
    /// A small image as a JPEG file, if there is an image.
    pub image_jpeg: Option<Vec<u8>>,
    /// A small picture of its depth, if it has depth.
    pub depth: Option<DepthThumbnail>,
}

/// A view, ready to be put into a page by [`crate::render_html`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EncodedView {
    /// JSON, safe inside a `<script>` element.
    json: String,
    /// What the controls need to know when the page is made.
    controls: page::Controls,
    /// Triangles kept, of all panes.
    triangles: usize,
    /// Points kept, of all panes.
    points: usize,
}

impl EncodedView {
    /// Size in the page, bytes.
    pub fn size_bytes(&self) -> usize {
        self.json.len()
    }

    /// Triangles that are drawn when all panes are shown.
    pub fn triangles(&self) -> usize {
        self.triangles
    }

    /// Points that are drawn when all panes show their points.
    pub fn points(&self) -> usize {
        self.points
    }
}

/// Simplifies, quantises and packs a view.
///
/// # Errors
/// [`ViewError::InconsistentSurface`], [`ViewError::WrongValueCount`].
pub fn encode_view(view: &InteractiveView<'_>) -> Result<EncodedView, ViewError> {
    payload::encode(view)
}

#[cfg(test)]
mod tests;
