//! Plots, pictures and the HTML report of a run.
//!
//! All functions turn values into pixels or into one HTML file, without any access to disk or screen: the caller
//! writes the bytes. A picture is an `Image<[u8; 3]>` in sRGB until [`encode_png`].
//!
//! - [`plot_trajectories_top_down`]: paths in metres, equal scale on both axes, ground truth where there is one.
//! - [`plot_lines`], [`plot_histogram`], [`plot_bars`]: errors over time, distributions, timings.
//! - [`depth_picture`], [`confidence_picture`], [`side_by_side`]: output of the geometry stage.
//! - [`render_map`]: a mesh or a cloud from a [`MapCamera`], by a software rasteriser.
//! - [`encode_view`]: maps to turn, walk through and measure in, drawn by WebGL in the page.
//! - [`render_html`]: a [`Report`] as one self-contained file.
//!
//! Plots and pictures never fail and never panic: values that are not finite are skipped, an empty input gives
//! empty axes with a note. The same input gives the same bytes for any number of threads.

mod axes;
mod canvas;
mod chart;
mod colormap;
mod error;
mod escape;
mod interactive;
mod lines;
mod map;
mod picture;
mod png_bytes;
mod report;
mod size;
mod text;
mod ticks;
mod top_down;

pub use chart::{BarGroup, BarPlot, Histogram, plot_bars, plot_histogram};
pub use colormap::ColorMap;
pub use error::ViewError;
pub use interactive::{
    DepthThumbnail, EncodedView, Field, FieldKind, FieldValues, InteractiveView, Pane, PanePath, PaneScale,
    PanesShown, PathRole, PosedThumbnail, depth_thumbnail, encode_view,
};
pub use lines::{AxisSpec, LinePlot, Mark, ReferenceLine, Series, plot_lines};
pub use map::camera::{BackFaces, MapCamera, Projection, Viewpoint, up_of_world};
pub use map::{MapSurface, Shading, render_map, render_map_with_path};
pub use picture::{confidence_picture, depth_picture, side_by_side};
pub use png_bytes::encode_png;
pub use report::{
    Assessment, AssessmentLevel, Figure, FigureWidth, Report, Section, SummaryItem, Table, render_html,
};
pub use size::PictureSize;
pub use ticks::{Ticks, nice_step};
pub use top_down::{
    PlotTrajectory, TrajectoryPlot, TrajectoryRole, plot_trajectories, plot_trajectories_top_down,
};

/// A picture: sRGB, row by row.
pub type Picture = vidar_core::Image<[u8; 3]>;
