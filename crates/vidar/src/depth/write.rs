//! The formats, each written atomically from one prediction.

use super::at_input::{Mapping, nearest};
use super::inputs::Picture;
use super::{DepthFormat, DepthRequest, Resolution, Unit};
use crate::error::Error;
use crate::events::{Event, Events};
use crate::run_folder::RunFolder;
use nalgebra::{Matrix3, Vector3};
use std::io::Cursor;
use vidar_core::{Image, LieGroup, MetricDepth, Pinhole, PointCloud, Se3, Warning};
use vidar_da3::Prediction;
use vidar_export::ExportError;
use vidar_export::official::{self, OriginalImage, PredictedView};

/// Steps per metre of a depth PNG, as RGB-D tools expect them.
const STEPS_PER_METRE: f64 = 1000.0;
/// Largest number of a 16-bit pixel.
const MOST_STEPS: f64 = 65_535.0;

/// Pose and intrinsics of a view, in VIDAR's conventions.
#[derive(Clone, Copy, Debug)]
pub(super) struct ViewCamera {
    pub world_from_camera: Se3,
    pub intrinsics: Pinhole,
}

/// Writes one prediction into one folder.
pub(super) struct Writer<'a> {
    pub folder: &'a RunFolder,
    pub request: &'a DepthRequest,
    pub pictures: &'a [Picture],
    pub prediction: &'a Prediction,
    pub unit: Unit,
    pub artifacts: Vec<String>,
    pub warnings: Vec<Warning>,
    /// Steps per unit of the depth PNGs, once they are written.
    pub depth_scale: Option<f64>,
    events: &'a Events,
}

impl<'a> Writer<'a> {
    pub fn new(
        folder: &'a RunFolder,
        events: &'a Events,
        request: &'a DepthRequest,
        pictures: &'a [Picture],
        prediction: &'a Prediction,
        unit: Unit,
    ) -> Self {
        let (artifacts, warnings) = (Vec::new(), Vec::new());
        Self { folder, request, pictures, prediction, unit, artifacts, warnings, depth_scale: None, events }
    }

    /// Writes every requested format.
    pub fn formats(&mut self) -> Result<(), Error> {
        let official = self.official();
        for format in &self.request.formats {
            match format {
                DepthFormat::DepthPng => self.depth_pngs()?,
                DepthFormat::Ply => self.ply(&official)?,
                DepthFormat::DepthVis => self.depth_vis(&official)?,
                DepthFormat::MiniNpz => {
                    let mut bytes = Cursor::new(Vec::new());
                    official::write_mini_npz(&mut bytes, &official)?;
                    self.bytes("exports/mini_npz/results.npz", &bytes.into_inner())?;
                }
                DepthFormat::Npz => {
                    let mut bytes = Cursor::new(Vec::new());
                    official::write_npz(&mut bytes, &official)?;
                    self.bytes("exports/npz/results.npz", &bytes.into_inner())?;
                }
                DepthFormat::Glb => self.glb(&official)?,
                DepthFormat::Colmap => self.colmap(&official)?,
            }
        }
        Ok(())
    }

    /// Writes a file and emits its event.
    pub fn bytes(&mut self, path: &str, bytes: &[u8]) -> Result<(), Error> {
        let bytes = self.folder.write(path, bytes)?;
        self.made(path, bytes);
        Ok(())
    }

    fn export(
        &mut self,
        path: &str,
        write: impl FnOnce(&mut dyn std::io::Write) -> Result<(), ExportError>,
    ) -> Result<(), Error> {
        let target = self.folder.file(path)?;
        vidar_export::atomic::write_atomically(&target, write)?;
        let bytes = std::fs::metadata(&target).map(|m| m.len()).unwrap_or(0);
        self.made(path, bytes);
        Ok(())
    }

    fn made(&mut self, path: &str, bytes: u64) {
        self.events.emit(&Event::ArtifactWritten { path: path.to_owned(), bytes });
        self.artifacts.push(path.to_owned());
    }

    /// The prediction in the official program's conventions.
    fn official(&self) -> official::Prediction {
        let p = self.prediction;
        let view = |i: usize| PredictedView {
            image: p.images.get(i).cloned(),
            depth: p.depth[i].clone(),
            confidence: p.confidence.as_ref().map(|c| c[i].clone()),
            extrinsics: p
                .camera_from_world
                .as_ref()
                .map(|m| std::array::from_fn(|r| std::array::from_fn(|c| m[i][(r, c)] as f32))),
            intrinsics: p
                .intrinsics
                .as_ref()
                .map(|k| std::array::from_fn(|r| std::array::from_fn(|c| k[i][(r, c)] as f32))),
        };
        official::Prediction { views: (0..p.depth.len()).map(view).collect() }
    }

    /// The camera of view `i` at the size of the network's maps.
    pub fn camera(&self, i: usize) -> Option<ViewCamera> {
        let matrix = self.prediction.intrinsics.as_ref()?.get(i)?;
        self.camera_with(i, matrix, (self.prediction.width(), self.prediction.height()))
    }

    fn camera_with(
        &self,
        i: usize,
        matrix: &Matrix3<f64>,
        (width, height): (usize, usize),
    ) -> Option<ViewCamera> {
        let camera_from_world = self.prediction.camera_from_world.as_ref()?.get(i)?;
        Some(ViewCamera {
            world_from_camera: Se3::from_matrix(camera_from_world)?.inverse(),
            intrinsics: vidar_da3::pose::from_edge(matrix, width, height)?,
        })
    }

    fn mapping(&self, i: usize) -> Result<Mapping, Error> {
        let image = &self.pictures[i].image;
        let processed = (self.prediction.width(), self.prediction.height());
        Ok(Mapping::new((image.width(), image.height()), processed, &self.request.infer.preprocess)?)
    }

    /// Depth of view `i` at the size that was requested.
    fn depth(&self, i: usize) -> Result<Image<f32>, Error> {
        let depth = &self.prediction.depth[i];
        match self.request.resolution {
            Resolution::Processed => Ok(depth.clone()),
            Resolution::Input => {
                let image = &self.pictures[i].image;
                Ok(self.mapping(i)?.at_image(depth, (image.width(), image.height())))
            }
        }
    }

    fn depth_pngs(&mut self) -> Result<(), Error> {
        let scale = self.steps_per_unit();
        let mut clipped = 0;
        for i in 0..self.prediction.depth.len() {
            // The file counts steps per unit; the unit is recorded in predictions.json.
            let depth = MetricDepth::new(self.depth(i)?);
            let mut bytes = Vec::new();
            clipped += vidar_export::write_depth_png(&mut bytes, &depth, scale)?.clipped;
            self.bytes(&depth_name(i), &bytes)?;
        }
        self.depth_scale = Some(scale);
        if clipped > 0 {
            let message = format!("{clipped} pixels exceed the range of {scale} steps per unit; they are 0");
            self.warnings.push(Warning::new("depth-clipped", message).hint("mini_npz keeps every depth"));
        }
        Ok(())
    }

    /// Millimetres, or for depth without a known unit the finest round number that reaches the farthest pixel.
    fn steps_per_unit(&self) -> f64 {
        if self.unit != Unit::Arbitrary {
            return STEPS_PER_METRE;
        }
        let depths = self.prediction.depth.iter().flat_map(|d| d.data()).filter(|z| z.is_finite());
        let farthest = depths.fold(0.0_f64, |far, z| far.max(f64::from(*z)));
        if farthest <= 0.0 {
            return STEPS_PER_METRE;
        }
        let finest = MOST_STEPS / farthest;
        let decade = 10_f64.powf(finest.log10().floor());
        [5.0, 2.0].into_iter().map(|n| n * decade).find(|s| *s <= finest).unwrap_or(decade)
    }

    fn ply(&mut self, official: &official::Prediction) -> Result<(), Error> {
        let least = official::confidence_percentile(official, &[self.request.scene.confidence_percentile])[0];
        let mut cloud = PointCloud::default();
        for i in 0..self.prediction.depth.len() {
            self.add_points(&mut cloud, i, least)?;
        }
        let cloud = thinned(cloud, self.request.scene.most_points);
        let comments = vec![
            "VIDAR depth".to_owned(),
            format!("model: {}", self.request.model.name()),
            format!("frame: {}", self.frame_words()),
            format!("unit: {}", unit_words(self.unit)),
        ];
        self.export("points.ply", |w| vidar_export::write_ply_cloud(w, &cloud, &comments))
    }

    /// The frame of poses and points.
    pub fn frame_words(&self) -> String {
        match (&self.request.poses, self.request.infer.align_to_given) {
            (Some(path), true) => format!("the world of {}", path.display()),
            _ => format!(
                "the network's frame, with the origin at the camera of view {}: x right, y down, z forward",
                self.prediction.reference_view
            ),
        }
    }

    fn add_points(&self, cloud: &mut PointCloud, i: usize, least: f64) -> Result<(), Error> {
        let depth = self.depth(i)?;
        let size = (depth.width(), depth.height());
        let confidence = self.prediction.confidence.as_ref().map(|c| &c[i]);
        let (camera, colors, confidence) = match self.request.resolution {
            Resolution::Processed => (self.camera(i), &self.prediction.images[i], confidence.cloned()),
            Resolution::Input => {
                let matrix = self
                    .prediction
                    .intrinsics
                    .as_ref()
                    .map(|k| self.mapping(i).map(|m| m.intrinsics_of_image(&k[i])));
                let camera = matrix.transpose()?.and_then(|k| self.camera_with(i, &k, size));
                (camera, &self.pictures[i].image, confidence.map(|c| nearest(c, size)))
            }
        };
        let Some(camera) = camera else {
            let reason = format!("the camera of view {i} is invalid");
            return Err(ExportError::Unwritable { format: "PLY", what: "a cloud".to_owned(), reason }.into());
        };
        for y in 0..size.1 {
            for x in 0..size.0 {
                let z = f64::from(depth[(x, y)]);
                let sure = confidence.as_ref().is_none_or(|c| f64::from(c[(x, y)]) >= least);
                if !(z.is_finite() && z > 0.0 && sure) {
                    continue;
                }
                let ray = camera.intrinsics.ray(x as f64, y as f64);
                let point: Vector3<f64> = camera.world_from_camera.act(&(ray * z));
                cloud.positions.push([point.x as f32, point.y as f32, point.z as f32]);
                cloud.colors.push(colors[(x, y)]);
                if let Some(confidence) = &confidence {
                    cloud.confidences.push(confidence[(x, y)]);
                }
            }
        }
        Ok(())
    }

    fn depth_vis(&mut self, official: &official::Prediction) -> Result<(), Error> {
        for i in 0..official.views.len() {
            let path = format!("depth_vis/{i:04}.jpg");
            if !self.artifacts.contains(&path) {
                self.export(&path, |w| official::write_depth_vis(w, official, i))?;
            }
        }
        Ok(())
    }

    /// As the official program: depth images next to the scene, and the first one as thumbnail of the scene.
    fn glb(&mut self, official: &official::Prediction) -> Result<(), Error> {
        let scene = self.request.scene.clone();
        self.export("scene.glb", |w| official::write_scene_glb(w, official, &scene).map(|_| ()))?;
        self.depth_vis(official)?;
        self.export("scene.jpg", |w| official::write_depth_vis(w, official, 0))
    }

    fn colmap(&mut self, official: &official::Prediction) -> Result<(), Error> {
        let original = |p: &Picture| OriginalImage {
            name: p.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
            width: p.image.width(),
            height: p.image.height(),
        };
        let originals: Vec<OriginalImage> = self.pictures.iter().map(original).collect();
        let folder = self.folder.path().join("colmap");
        let percentile = self.request.scene.confidence_percentile;
        official::write_official_colmap(&folder, official, &originals, percentile)?;
        for name in ["cameras", "images", "points3D", "rigs", "frames"] {
            let path = format!("colmap/{name}.bin");
            let bytes = std::fs::metadata(self.folder.path().join(&path)).map(|m| m.len()).unwrap_or(0);
            self.made(&path, bytes);
        }
        Ok(())
    }
}

/// The depth PNG of view `i`.
pub(super) fn depth_name(i: usize) -> String {
    format!("depth/{i:04}.png")
}

/// The unit as text.
pub(super) fn unit_words(unit: Unit) -> &'static str {
    match unit {
        Unit::Metre => "metre",
        Unit::GivenCameras => "that of the given cameras",
        Unit::Arbitrary => "unknown (one factor for all views)",
    }
}

fn thinned(cloud: PointCloud, most: usize) -> PointCloud {
    if cloud.len() <= most {
        return cloud;
    }
    let chosen = official::thinned(cloud.len(), most);
    fn pick<T: Copy>(list: &[T], chosen: &[usize]) -> Vec<T> {
        chosen.iter().filter_map(|&i| list.get(i).copied()).collect()
    }
    PointCloud {
        positions: pick(&cloud.positions, &chosen),
        normals: Vec::new(),
        colors: pick(&cloud.colors, &chosen),
        confidences: pick(&cloud.confidences, &chosen),
    }
}
