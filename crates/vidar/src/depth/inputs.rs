//! Images from files and folders, and their known cameras.

use crate::error::Error;
use crate::export::read_views;
use crate::run::pose_of;
use nalgebra::{Matrix3, Matrix4};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_core::{Duration, Image, LieGroup, Pinhole, Se3};
use vidar_dataset::decode::{read_image, read_size};
use vidar_dataset::{OpenOptions, Recording, RecordingKind};

/// A decoded image.
pub(super) struct Picture {
    pub path: PathBuf,
    pub image: Image<[u8; 3]>,
}

/// One image to predict depth of: a file, or an image inside a recording.
#[derive(Clone, Debug)]
pub(super) struct Source {
    /// Its file; of an image inside a recording a name that states both.
    pub path: PathBuf,
    recording: Option<(Arc<Recording>, usize)>,
}

/// Most images that are taken of a video or bag. All images are predicted together, and the cost grows with the square of their
/// number; the couplings' chunks are of this order.
const MOST_OF_A_RECORDING: usize = 16;
/// Least time between two images of a video or bag: without motion between them a second one adds nothing.
const BETWEEN_IMAGES: Duration = Duration::from_millis(500);

/// The images of files, folders and recordings, in the order given; within a folder in natural order.
pub(super) fn list(inputs: &[PathBuf]) -> Result<Vec<Source>, Error> {
    let mut images = Vec::new();
    let of_file = |path: PathBuf| Source { path, recording: None };
    for input in inputs {
        if input.is_dir() {
            let options = OpenOptions { format: Some(RecordingKind::ImageFolder), ..OpenOptions::default() };
            let folder = vidar_dataset::open(input, &options)?;
            let files = folder.images.iter().filter_map(|entry| entry.location.as_file());
            images.extend(files.map(|path| of_file(path.to_owned())));
        } else if is_recording(input) {
            images.extend(of_recording(input)?);
        } else {
            images.push(of_file(input.clone()));
        }
    }
    if images.is_empty() {
        let what = "no image was given".to_owned();
        let hint = "name images, folders of images, a video or a bag".to_owned();
        return Err(Error::Usage { what, hint });
    }
    Ok(images)
}

fn is_recording(path: &Path) -> bool {
    let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    ["mp4", "mov", "m4v", "bag", "mcap", "db3"].contains(&ending.as_str())
}

/// Images of a recording, spread evenly over it.
fn of_recording(path: &Path) -> Result<Vec<Source>, Error> {
    let dataset = Arc::new(vidar_dataset::open(path, &OpenOptions::default())?);
    let length = match dataset.images.as_slice() {
        [first, .., last] => last.time - first.time,
        _ => Duration::ZERO,
    };
    let fitting = usize::try_from(length.nanos() / BETWEEN_IMAGES.nanos()).unwrap_or(0) + 1;
    let (count, listed) = (fitting.min(MOST_OF_A_RECORDING), dataset.images.len());
    let at = |i: usize| if count > 1 { i * (listed - 1) / (count - 1) } else { 0 };
    let name = |number: usize| path.with_extension("").join(format!("{number:06}"));
    let source =
        |number: usize| Source { path: name(number), recording: Some((Arc::clone(&dataset), number)) };
    Ok((0..count.min(listed)).map(at).map(source).collect())
}

impl Source {
    /// Columns and rows.
    pub fn size(&self) -> Result<(usize, usize), Error> {
        match &self.recording {
            None => Ok(read_size(&self.path)?),
            // All images of a recording have its camera's size.
            Some((dataset, _)) => {
                Ok(dataset.rig.camera(dataset.camera).map_or((0, 0), |c| (c.model.width(), c.model.height())))
            }
        }
    }

    fn read(&self) -> Result<Picture, Error> {
        let image = match &self.recording {
            None => read_image(&self.path)?,
            Some((dataset, number)) => dataset.load_image(&dataset.images[*number])?,
        };
        Ok(Picture { path: self.path.clone(), image: image.to_rgb8() })
    }
}

/// Decodes all images; stops at the first one that cannot be read.
pub(super) fn read_all(sources: &[Source]) -> Result<Vec<Picture>, Error> {
    sources.par_iter().map(Source::read).collect()
}

/// Cameras by image name, read from a file or folder.
pub(super) struct Cameras {
    /// Format of the source.
    pub source: &'static str,
    path: PathBuf,
    views: Vec<(String, Se3, Pinhole)>,
}

/// Known cameras of the images, in the network's conventions.
pub(super) struct KnownCameras {
    pub source: &'static str,
    pub camera_from_world: Vec<Matrix4<f64>>,
    /// In pixels of the images, from the edge of the top-left one.
    pub intrinsics: Vec<Matrix3<f64>>,
}

impl Cameras {
    /// Reads a `transforms.json`, a folder with a COLMAP model, or a run folder.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let foreign = |source: &'static str, views: Vec<vidar_export::ImportedView>| Self {
            source,
            path: path.to_owned(),
            views: views.into_iter().map(|v| (v.image_name, v.world_from_camera, v.intrinsics)).collect(),
        };
        if path.is_file() {
            let bytes = crate::system::read_up_to(path, crate::system::MAX_CLOUD_BYTES)
                .map_err(|e| Error::io("read", path, e))?;
            let read = vidar_export::read_transforms_json(&bytes)?;
            return Ok(foreign("transforms.json", read.views));
        }
        if path.join("views.json").is_file() {
            let views = read_views(path)?;
            let view =
                |v: &crate::run_folder::StoredView| Some((v.image.clone()?, pose_of(v)?, v.intrinsics));
            let views = views.iter().filter_map(view).collect();
            return Ok(Self { source: "a run of VIDAR", path: path.to_owned(), views });
        }
        let model = ["", "sparse/0", "sparse"]
            .iter()
            .map(|sub| path.join(sub))
            .find(|folder| folder.join("cameras.bin").is_file() || folder.join("cameras.txt").is_file());
        match model {
            Some(folder) => Ok(foreign("a COLMAP model", vidar_export::read_colmap(&folder)?.views)),
            None => Err(Error::Usage {
                what: format!("--poses {}: no cameras and no file", path.display()),
                hint: "give a transforms.json, a folder with a COLMAP model, or a run folder".to_owned(),
            }),
        }
    }

    /// Number of cameras.
    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// The cameras of these images, at their sizes. Every image needs one.
    pub fn of_images(&self, images: &[PathBuf], sizes: &[(usize, usize)]) -> Result<KnownCameras, Error> {
        let (mut camera_from_world, mut intrinsics) = (Vec::new(), Vec::new());
        for (image, &(width, height)) in images.iter().zip(sizes) {
            let (_, world_from_camera, pinhole) = self.find(image)?;
            let pinhole = match (pinhole.width, pinhole.height) == (width, height) {
                true => *pinhole,
                false => pinhole.resized(width, height)?,
            };
            camera_from_world.push(world_from_camera.inverse().matrix());
            intrinsics.push(vidar_da3::pose::to_edge(&pinhole));
        }
        Ok(KnownCameras { source: self.source, camera_from_world, intrinsics })
    }

    /// The one camera whose image has the longest common end with this path.
    fn find(&self, image: &Path) -> Result<&(String, Se3, Pinhole), Error> {
        let common = |name: &str| {
            let own = image.components().rev();
            Path::new(name).components().rev().zip(own).take_while(|(a, b)| a == b).count()
        };
        let best = self.views.iter().map(|v| (common(&v.0), v)).max_by_key(|(n, _)| *n);
        let wrong = |why: &str| Error::Usage {
            what: format!("--poses {}: {why} {}", self.path.display(), image.display()),
            hint: "every image needs a camera of the same file name; remove the images without one"
                .to_owned(),
        };
        match best {
            Some((n, view)) if n > 0 => {
                let twins = self.views.iter().filter(|v| common(&v.0) == n).count();
                if twins > 1 { Err(wrong("several cameras match")) } else { Ok(view) }
            }
            _ => Err(wrong("no camera for")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn cameras(names: &[&str]) -> Cameras {
        let pinhole = Pinhole::new(100.0, 100.0, 49.5, 39.5, 100, 80).unwrap();
        let view = |(i, name): (usize, &&str)| {
            ((*name).to_owned(), Se3::from_translation(Vector3::new(i as f64, 0.0, 0.0)), pinhole)
        };
        Cameras { source: "test", path: "p".into(), views: names.iter().enumerate().map(view).collect() }
    }

    #[test]
    fn cameras_are_found_by_the_end_of_the_path() {
        let known = cameras(&["left/0.png", "right/0.png", "left/1.png"]);
        let images = ["/data/right/0.png".into(), "1.png".into()];
        let given = known.of_images(&images, &[(100, 80), (50, 40)]).unwrap();
        assert_eq!(given.camera_from_world[0][(0, 3)], -1.0);
        assert_eq!(given.camera_from_world[1][(0, 3)], -2.0);
        // From the edge, at the image's own size.
        assert_eq!((given.intrinsics[0][(0, 2)], given.intrinsics[1][(0, 2)]), (50.0, 25.0));
        assert_eq!(given.intrinsics[1][(0, 0)], 50.0);
        let error = |image: &str| known.find(Path::new(image)).unwrap_err().to_string();
        assert!(error("2.png").contains("no camera for 2.png"));
        assert!(error("0.png").contains("several cameras"));
    }
}
