//! Keyframes into one metric surface, chunk after chunk.

use super::MetricMap;
use super::plan::{ChunkPlan, Plan};
use super::views::ViewWindow;
use crate::config::Config;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::models;
use crate::run_folder::{RunFolder, StoredView};
use rayon::prelude::*;
use vidar_align::{Anchor, aligned_views, place_chunk};
use vidar_core::remap::RemapTable;
use vidar_core::{AlignedView, ChunkId, ChunkView, ChunkViews, GeometryModel, ModelError, Warning};
use vidar_dataset::Dataset;
use vidar_fusion::{PointFusion, TsdfVolume};
use vidar_stereo::StereoModel;

/// The geometry model that the configuration names.
pub fn model(config: &Config) -> Result<Box<dyn GeometryModel>, Error> {
    match models::geometry::chosen(config)? {
        None => Ok(Box::new(StereoModel::new(config.stereo.clone())?)),
        Some(choice) => Ok(Box::new(models::geometry::open(&choice, config)?.0)),
    }
}

/// Reads, predicts, places and fuses every chunk. Stops between chunks when cancelled and keeps what is fused.
pub fn build(
    dataset: &Dataset,
    plan: &Plan,
    config: &Config,
    folder: &RunFolder,
    events: &Events,
    cancel: &CancelToken,
) -> Result<MetricMap, Error> {
    let remap = RemapTable::new(&plan.camera, &plan.view);
    let mut window = ViewWindow::new(dataset, &plan.keyframes, &remap);
    let mut model = model(config)?;
    let mut surface =
        Surface { volume: TsdfVolume::new(&config.fusion)?, points: PointFusion::new(&config.fusion)? };
    let mut map = MetricMap::default();
    let mut failures: Vec<String> = Vec::new();
    events.stage("depth", plan.keyframes.len(), || -> Result<(), Error> {
        for (number, chunk) in plan.chunks.iter().enumerate() {
            if cancel.is_cancelled() {
                break;
            }
            window.advance(&chunk.seen, events);
            let id = ChunkId(u32::try_from(number).unwrap_or(u32::MAX));
            let views =
                predict_and_place(&mut window, chunk, id, model.as_mut(), plan, config, events, cancel)?;
            match views {
                Ok(views) => {
                    surface.fuse(&views, events)?;
                    map.depth_scores.add(dataset, &views);
                    map.views.extend(store(&views, config, folder, events)?);
                }
                Err(reason) => failures.push(reason),
            }
            let (done, total) = (chunk.core.end, plan.keyframes.len());
            events.emit(&Event::Progress { stage: "depth", done, total });
        }
        Ok(())
    })?;
    if map.views.is_empty() && !cancel.is_cancelled() {
        let reason = failures.pop().unwrap_or_else(|| "no keyframe image could be read".into());
        return Err(Error::Empty { keyframes: plan.keyframes.len(), reason });
    }
    events.stage("surface", 0, || {
        surface.extract(&mut map);
        Ok::<(), Error>(())
    })?;
    map.warnings.iter().for_each(|w| events.warn(w));
    Ok(map)
}

/// The chunk's metric views, or the reason why it has none (already warned of).
#[allow(clippy::too_many_arguments)] // the stage's collaborators, each used once; a bundle would only rename them
fn predict_and_place(
    window: &mut ViewWindow<'_>,
    chunk: &ChunkPlan,
    id: ChunkId,
    model: &mut dyn GeometryModel,
    plan: &Plan,
    config: &Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Result<Vec<AlignedView>, String>, Error> {
    let (views, wanted, indices) = window.take(&chunk.core);
    let views = ChunkViews { id, views };
    let prediction = model.predict_wanted(&views, wanted, &|| cancel.is_cancelled());
    let placed = match prediction {
        Err(ModelError::Cancelled) => Ok(Vec::new()),
        Err(error) => Err(Warning::new("chunk-failed", error.to_string()).at(format!("chunk {id}"))),
        Ok(prediction) => {
            let anchors: Vec<Anchor> = plan.keyframes[chunk.seen.clone()]
                .iter()
                .map(|k| Anchor { frame_id: k.image.frame_id, world_from_camera: k.world_from_camera })
                .collect();
            let missing = chunk.core.len().saturating_sub(prediction.views.len());
            if missing > 0 && !prediction.views.is_empty() {
                let message = format!("{missing} of {} keyframes got no depth", chunk.core.len());
                events.warn(&Warning::new("keyframes-without-depth", message).at(format!("chunk {id}")));
            }
            place(prediction, &anchors, &views.views, config, events)?
        }
    };
    window.put_back(views.views, indices);
    Ok(placed.map_err(|warning| {
        events.warn(&warning);
        warning.message
    }))
}

fn place(
    prediction: vidar_core::GeometryPrediction,
    anchors: &[Anchor],
    views: &[ChunkView],
    config: &Config,
    events: &Events,
) -> Result<Result<Vec<AlignedView>, Warning>, Error> {
    if prediction.views.is_empty() {
        let place = format!("chunk {}", prediction.chunk_id);
        return Ok(Err(Warning::new("no-parallax", "no keyframe of the chunk got depth").at(place)));
    }
    let alignment = place_chunk(&prediction, anchors, &config.align)?;
    events.emit(&Event::ChunkAligned {
        chunk: alignment.chunk_id.0,
        scale: alignment.world_from_chunk.scale,
        center_rms_m: alignment.center_rms_m,
        verdict: alignment.verdict,
    });
    if !alignment.verdict.is_usable() {
        let message = format!(
            "placement is {:?}: camera centres {:.3} m RMS off their anchors",
            alignment.verdict, alignment.center_rms_m
        );
        let place = format!("chunk {}", alignment.chunk_id);
        return Ok(Err(Warning::new("chunk-not-placed", message).at(place)));
    }
    Ok(Ok(aligned_views(prediction, &alignment, views)?))
}

/// Both forms of the surface, fed with the same views.
struct Surface {
    volume: TsdfVolume,
    points: PointFusion,
}

impl Surface {
    fn fuse(&mut self, views: &[AlignedView], events: &Events) -> Result<(), Error> {
        for view in views {
            // A view that cannot be fused is a named degradation of the map, not the end of the run.
            for result in [self.volume.integrate(view).map(|_| ()), self.points.integrate(view).map(|_| ())] {
                if let Err(error) = result {
                    let place = format!("frame {}", view.frame_id());
                    events.warn(&Warning::new("view-not-fused", error.to_string()).at(place));
                }
            }
        }
        Ok(())
    }

    fn extract(self, map: &mut MetricMap) {
        map.mesh = self.volume.extract_mesh();
        map.coverage = self.volume.coverage(&map.mesh);
        map.volume_bytes = self.volume.peak_memory_bytes();
        map.warnings = self.volume.warnings();
        map.warnings.extend(self.points.warnings());
        map.cloud = self.points.finish();
    }
}

/// Writes depth and image of every view as it is finished, so that a crash later loses nothing.
fn store(
    views: &[AlignedView],
    config: &Config,
    folder: &RunFolder,
    events: &Events,
) -> Result<Vec<StoredView>, Error> {
    folder.file("depth/.")?;
    folder.file("images/.")?;
    let stored: Result<Vec<_>, Error> =
        views.par_iter().map(|view| store_one(view, config, folder)).collect();
    let stored = stored?;
    for (_, artifacts) in &stored {
        for (path, bytes) in artifacts {
            events.emit(&Event::ArtifactWritten { path: path.clone(), bytes: *bytes });
        }
    }
    Ok(stored.into_iter().map(|(view, _)| view).collect())
}

type Artifacts = Vec<(String, u64)>;

fn store_one(
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
        image,
        depth,
        intrinsics: *view.intrinsics(),
        world_from_camera: rows,
    };
    Ok((stored, artifacts))
}
