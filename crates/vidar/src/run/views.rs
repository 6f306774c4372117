//! Files of the keyframes that were fused: depth and undistorted image.

use crate::config::Config;
use crate::error::Error;
use crate::events::{Event, Events};
use crate::run_folder::{RunFolder, StoredView};
use rayon::prelude::*;
use vidar_core::AlignedView;

/// Writes depth and image of every view as it is finished, so that a crash later loses nothing.
pub(super) fn write_views(
    views: &[AlignedView],
    config: &Config,
    folder: &RunFolder,
    events: &Events,
) -> Result<Vec<StoredView>, Error> {
    folder.file("depth/.")?;
    folder.file("images/.")?;
    let stored: Result<Vec<_>, Error> =
        views.par_iter().map(|view| write_view(view, config, folder)).collect();
    let stored = stored?;
    for (_, artifacts) in &stored {
        for (path, bytes) in artifacts {
            events.emit(&Event::ArtifactWritten { path: path.clone(), bytes: *bytes });
        }
    }
    Ok(stored.into_iter().map(|(view, _)| view).collect())
}

type Artifacts = Vec<(String, u64)>;

fn write_view(
    view: &AlignedView,
    config: &Config,
    folder: &RunFolder,
) -> Result<(StoredView, Artifacts), Error> {
    let mut artifacts = Artifacts::new();
    let name = format!("{:06}.png", view.frame_id().0);
    let mut depth = None;
    if config.output.depth_png {
        let path = format!("depth/{name}");
        let mut bytes = Vec::new();
        vidar_export::write_depth_png(&mut bytes, view.depth(), config.output.depth_units_per_metre)?;
        artifacts.push((path.clone(), folder.write(&path, &bytes)?));
        depth = Some(path);
    }
    let mut image = None;
    if let (true, Some(color)) = (config.output.images, view.color()) {
        let path = format!("images/{name}");
        artifacts.push((path.clone(), folder.write(&path, &vidar_view::encode_png(color)?)?));
        image = Some(path);
    }
    let m = view.world_from_camera().matrix();
    let rows = std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)]));
    let stored = StoredView {
        frame: view.frame_id().0,
        time_ns: view.time().nanos(),
        source: None,
        image,
        depth,
        intrinsics: *view.intrinsics(),
        world_from_camera: rows,
    };
    Ok((stored, artifacts))
}
