//! `vidar export`: formats of other programs, made from a finished run folder.

mod at_input;
mod scene;
mod textured;
mod tracks;

use crate::error::Error;
use crate::run::pose_of;
use crate::run_folder::{StoredCamera, StoredView, VIEWS_SCHEMA};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use vidar_core::{BodyFrame, CameraId, FrameId, PointCloud, StampedPose, Timestamp, Trajectory};
use vidar_export::{ColmapFormat, ExportView};

/// The target format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExportTarget {
    /// COLMAP model, binary, with the images.
    Colmap,
    /// COLMAP model, text.
    ColmapText,
    /// nerfstudio `transforms.json`.
    Nerfstudio,
    /// Keyframe poses, TUM.
    Tum,
    /// Keyframe poses, KITTI with a file of times.
    Kitti,
    /// Keyframe poses, EuRoC csv.
    Euroc,
    /// Mesh and points as PLY.
    Ply,
    /// Mesh as GLB.
    Glb,
    /// Mesh as GLB with a texture from the keyframes' images.
    TexturedGlb,
    /// Everything as Foxglove and Rerun show it.
    Mcap,
}

/// Names on the command line.
pub const TARGETS: &[(&str, ExportTarget)] = &[
    ("colmap", ExportTarget::Colmap),
    ("colmap-text", ExportTarget::ColmapText),
    ("nerfstudio", ExportTarget::Nerfstudio),
    ("tum", ExportTarget::Tum),
    ("kitti", ExportTarget::Kitti),
    ("euroc", ExportTarget::Euroc),
    ("ply", ExportTarget::Ply),
    ("glb", ExportTarget::Glb),
    ("textured-glb", ExportTarget::TexturedGlb),
    ("mcap", ExportTarget::Mcap),
];

impl FromStr for ExportTarget {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let names = || TARGETS.iter().map(|(n, _)| *n).collect::<Vec<_>>().join(", ");
        TARGETS
            .iter()
            .find(|(name, _)| *name == text)
            .map(|(_, t)| *t)
            .ok_or_else(|| format!("{text:?} is not one of {}", names()))
    }
}

/// What an export holds beside what it must.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExportOptions {
    /// COLMAP: every point with the images that see it.
    pub tracks: bool,
    /// COLMAP, nerfstudio and textures: images at the size of the recording's, undistorted again from its files.
    pub input_size: bool,
    /// Textures: most texels along an edge.
    pub texture_px: Option<usize>,
}

impl ExportTarget {
    fn check(self, options: ExportOptions) -> Result<(), Error> {
        let is_colmap = matches!(self, Self::Colmap | Self::ColmapText);
        let is_textured = self == Self::TexturedGlb;
        let has_images = is_colmap || is_textured || self == Self::Nerfstudio;
        if let Some(max_px) = options.texture_px {
            let refused = match is_textured {
                false => Some("only textured-glb has a texture".to_owned()),
                true => vidar_fusion::TextureConfig { max_px }.validate().err().map(|e| e.to_string()),
            };
            if let Some(reason) = refused {
                let what = format!("--texture-px: {reason}");
                return Err(Error::Usage { what, hint: "leave it out".to_owned() });
            }
        }
        let refused = match options {
            ExportOptions { tracks: true, .. } if !is_colmap => {
                "--tracks: only colmap and colmap-text have tracks"
            }
            ExportOptions { input_size: true, .. } if !has_images => {
                "--input-size: only colmap, colmap-text, nerfstudio and textured-glb hold images"
            }
            _ => return Ok(()),
        };
        Err(Error::Usage { what: refused.to_owned(), hint: "leave it out".to_owned() })
    }
}

#[derive(Deserialize)]
struct StoredViews {
    schema: String,
    #[serde(default)]
    camera: Option<StoredCamera>,
    views: Vec<StoredView>,
}

/// Reads the keyframes of a run folder.
pub fn read_views(run: &Path) -> Result<Vec<StoredView>, Error> {
    read_stored(run).map(|stored| stored.views)
}

fn read_stored(run: &Path) -> Result<StoredViews, Error> {
    let not_a_run = |reason: String| Error::NotARun { path: run.to_owned(), reason };
    let stored: StoredViews = crate::run_folder::read_json(run, "views.json")?;
    if stored.schema != VIEWS_SCHEMA {
        return Err(not_a_run(format!(
            "views.json has schema {:?}, expected {VIEWS_SCHEMA:?}",
            stored.schema
        )));
    }
    Ok(stored)
}

/// Makes `target` from the run folder `run` in the folder `out` and returns the files made.
///
/// # Errors
/// The folder is none of a run, lacks what the target needs, or cannot be written; options that the target does not have.
pub fn export_run(
    run: &Path,
    target: ExportTarget,
    options: ExportOptions,
    out: &Path,
) -> Result<Vec<PathBuf>, Error> {
    target.check(options)?;
    // A folder that is not a run folder is refused before any file is written.
    let stored = read_stored(run)?;
    std::fs::create_dir_all(out).map_err(|e| Error::io("create", out, e))?;
    match target {
        ExportTarget::Colmap => colmap(run, &stored, out, ColmapFormat::Binary, options),
        ExportTarget::ColmapText => colmap(run, &stored, out, ColmapFormat::Text, options),
        ExportTarget::Nerfstudio => nerfstudio(run, &stored, out, options),
        ExportTarget::Tum | ExportTarget::Kitti | ExportTarget::Euroc => trajectory(&stored, target, out),
        ExportTarget::Ply => {
            ["mesh.ply", "points.ply"].iter().map(|name| copy(run, "map", name, out)).collect()
        }
        ExportTarget::Glb => Ok(vec![glb(run, out)?]),
        ExportTarget::TexturedGlb => Ok(vec![textured::glb(run, &stored, options, out)?]),
        ExportTarget::Mcap => Ok(vec![scene::mcap(run, &stored, out)?]),
    }
}

/// The run's GLB, or one made from its mesh if the run did not write it.
fn glb(run: &Path, out: &Path) -> Result<PathBuf, Error> {
    if run.join("map/mesh.glb").is_file() {
        return copy(run, "map", "mesh.glb", out);
    }
    let path = run.join("map/mesh.ply");
    let bytes = crate::system::read_up_to(&path, crate::system::MAX_CLOUD_BYTES)
        .map_err(|e| Error::io("read", &path, e))?;
    let mut ply = vidar_export::read_ply(&bytes)?;
    // Frame and unit among them.
    let comments = std::mem::take(&mut ply.comments);
    let mesh = ply.into_mesh();
    let target = out.join("mesh.glb");
    vidar_export::atomic::write_atomically(&target, |w| vidar_export::write_glb_mesh(w, &mesh, &comments))?;
    Ok(target)
}

fn colmap(
    run: &Path,
    stored: &StoredViews,
    out: &Path,
    format: ColmapFormat,
    options: ExportOptions,
) -> Result<Vec<PathBuf>, Error> {
    let mut views = export_views(run, stored)?;
    let images = images(run, stored, &mut views, options, out)?;
    let mut cloud = points(run)?;
    let mut observations = Vec::new();
    if options.tracks {
        cloud = tracks::thinned(cloud);
        observations = tracks::observations(run, stored, &cloud, &views)?;
    }
    let sparse = out.join("sparse").join("0");
    std::fs::create_dir_all(&sparse).map_err(|e| Error::io("create", &sparse, e))?;
    vidar_export::write_colmap(&sparse, format, &views, &cloud, &observations)?;
    Ok(vec![sparse, images])
}

fn nerfstudio(
    run: &Path,
    stored: &StoredViews,
    out: &Path,
    options: ExportOptions,
) -> Result<Vec<PathBuf>, Error> {
    let mut views = export_views(run, stored)?;
    let images = images(run, stored, &mut views, options, out)?;
    views.iter_mut().for_each(|v| v.image_name = format!("images/{}", v.image_name));
    let json = out.join("transforms.json");
    let points = copy(run, "map", "points.ply", out)?;
    vidar_export::atomic::write_atomically(&json, |w| {
        vidar_export::write_transforms_json(w, &views, Some("points.ply"))
    })?;
    Ok(vec![json, points, images])
}

fn trajectory(stored: &StoredViews, target: ExportTarget, out: &Path) -> Result<Vec<PathBuf>, Error> {
    let poses = stored
        .views
        .iter()
        .filter_map(|v| {
            Some(StampedPose { time: Timestamp::from_nanos(v.time_ns), world_from_body: pose_of(v)? })
        })
        .collect();
    let trajectory = Trajectory::new(BodyFrame::Camera(CameraId(0)), poses)?;
    let note = "keyframes of a VIDAR run";
    let write = |name: &str, f: &dyn Fn(&mut dyn std::io::Write) -> Result<(), vidar_export::ExportError>| {
        let path = out.join(name);
        vidar_export::atomic::write_atomically(&path, f)?;
        Ok::<PathBuf, Error>(path)
    };
    match target {
        ExportTarget::Kitti => Ok(vec![
            write("keyframes.kitti.txt", &|w| vidar_export::write_kitti(w, &trajectory))?,
            write("keyframes.kitti.times.txt", &|w| vidar_export::write_kitti_times(w, &trajectory, note))?,
        ]),
        ExportTarget::Euroc => {
            Ok(vec![write("keyframes.euroc.csv", &|w| vidar_export::write_euroc_csv(w, &trajectory, note))?])
        }
        _ => Ok(vec![write("keyframes.tum", &|w| vidar_export::write_tum(w, &trajectory, note))?]),
    }
}

fn export_views(run: &Path, stored: &StoredViews) -> Result<Vec<ExportView>, Error> {
    let views: Vec<ExportView> = stored
        .views
        .iter()
        .filter_map(|v| {
            Some(ExportView {
                frame_id: FrameId(v.frame),
                time: Timestamp::from_nanos(v.time_ns),
                image_name: v.image.as_ref()?.rsplit('/').next()?.to_owned(),
                world_from_camera: pose_of(v)?,
                intrinsics: v.intrinsics,
            })
        })
        .collect();
    if views.is_empty() {
        let reason = "it holds no images; run again with output.images = true".to_owned();
        return Err(Error::NotARun { path: run.to_owned(), reason });
    }
    Ok(views)
}

/// Units per metre of the run's depth images; none where it kept none.
pub(crate) fn depth_units(run: &Path) -> Result<Option<f64>, Error> {
    let sidecar = run.join("depth/depth.json");
    if !sidecar.is_file() {
        return Ok(None);
    }
    let bytes = crate::system::read_up_to(&sidecar, crate::system::MAX_JSON_BYTES)
        .map_err(|e| Error::io("read", &sidecar, e))?;
    Ok(Some(vidar_export::DepthSidecar::read(&bytes)?.scale))
}

pub(crate) fn points(run: &Path) -> Result<PointCloud, Error> {
    let path = run.join("map/points.ply");
    let bytes = crate::system::read_up_to(&path, crate::system::MAX_CLOUD_BYTES)
        .map_err(|e| Error::io("read", &path, e))?;
    Ok(vidar_export::read_ply(&bytes)?.cloud)
}

fn copy(run: &Path, folder: &str, name: &str, out: &Path) -> Result<PathBuf, Error> {
    let (from, to) = (run.join(folder).join(name), out.join(name));
    let bytes = std::fs::read(&from).map_err(|e| Error::io("read", &from, e))?;
    vidar_export::atomic::write_file_atomically(&to, &bytes)?;
    Ok(to)
}

/// The folder of the views' images: those of the run, or new ones, whose size the views then have.
fn images(
    run: &Path,
    stored: &StoredViews,
    views: &mut [ExportView],
    options: ExportOptions,
    out: &Path,
) -> Result<PathBuf, Error> {
    let images = out.join("images");
    std::fs::create_dir_all(&images).map_err(|e| Error::io("create", &images, e))?;
    if options.input_size {
        at_input::undistort(run, stored, views, &images)?;
    } else {
        views.iter().try_for_each(|view| copy(run, "images", &view.image_name, &images).map(|_| ()))?;
    }
    Ok(images)
}
