//! Images from files and folders, and their known cameras.

use crate::error::Error;
use crate::export::read_views;
use crate::run::pose_of;
use nalgebra::{Matrix3, Matrix4};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use vidar_core::{Image, LieGroup, Pinhole, Se3};
use vidar_dataset::decode::{ImageLimits, read_image, read_size};
use vidar_dataset::{DatasetKind, OpenOptions};

/// A decoded image.
pub(super) struct Picture {
    pub path: PathBuf,
    pub image: Image<[u8; 3]>,
}

/// The images of files and folders, in the order given; within a folder in natural order.
pub(super) fn list(inputs: &[PathBuf]) -> Result<Vec<PathBuf>, Error> {
    let mut images = Vec::new();
    for input in inputs {
        if input.is_dir() {
            let options = OpenOptions { format: Some(DatasetKind::ImageFolder), ..OpenOptions::default() };
            let folder = vidar_dataset::open(input, &options)?;
            images.extend(
                folder.images.iter().filter_map(|entry| entry.location.as_file().map(Path::to_owned)),
            );
        } else {
            images.push(input.clone());
        }
    }
    if images.is_empty() {
        let (what, hint) = ("no image was given".to_owned(), "name images or folders of images".to_owned());
        return Err(Error::Usage { what, hint });
    }
    Ok(images)
}

/// Columns and rows of an image file.
pub(super) fn size_of(path: &Path) -> Result<(usize, usize), Error> {
    Ok(read_size(path, &ImageLimits::default())?)
}

/// Decodes all images; stops at the first one that cannot be read.
pub(super) fn read_all(paths: &[PathBuf]) -> Result<Vec<Picture>, Error> {
    let read = |path: &PathBuf| {
        let image = read_image(path, &ImageLimits::default())?.to_rgb8();
        Ok(Picture { path: path.clone(), image })
    };
    paths.par_iter().map(read).collect()
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
