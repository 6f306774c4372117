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
    if views.iter().any(|v| v.origin().is_some()) {
        folder.file("depth_source/.")?;
        folder.file("depth_std/.")?;
    }
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
    let (mut depth_source, mut depth_std) = (None, None);
    if let (true, Some(origins)) = (config.output.depth_png, view.origin()) {
        let mut write = |path: String, bytes: Vec<u8>| -> Result<Option<String>, Error> {
            artifacts.push((path.clone(), folder.write(&path, &bytes)?));
            Ok(Some(path))
        };
        let (mut source, mut std) = (Vec::new(), Vec::new());
        vidar_export::write_source_png(&mut source, origins)?;
        vidar_export::write_std_png(&mut std, origins)?;
        depth_source = write(format!("depth_source/{name}"), source)?;
        depth_std = write(format!("depth_std/{name}"), std)?;
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
        depth_source,
        depth_std,
        intrinsics: *view.intrinsics(),
        world_from_camera: rows,
    };
    Ok((stored, artifacts))
}
