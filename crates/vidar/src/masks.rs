//! Masks of images: pixels that no stage may use, such as people who walk about and the camera's own carrier.
//!
//! As COLMAP (`ImageReader.mask_path`) and nerfstudio (`mask_path`) have them: black (zero) is ignored, everything else is used. A mask of
//! `left/0001.jpg` is called `0001.jpg.png` (COLMAP's name) or `0001.png`; that of an image inside a recording is called by the image's
//! number with six digits, as a run's own `images/` are. An image without a mask is used whole.

use crate::error::Error;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use vidar_core::{FrameId, FrameImage, Image};
use vidar_dataset::decode::{read_image, read_size};
use vidar_dataset::{DatasetError, ImageEntry, Recording};

/// The masks of a recording's images.
#[derive(Clone, Debug)]
pub struct Masks {
    files: BTreeMap<FrameId, PathBuf>,
    /// Of names and contents.
    sha256: String,
    images: usize,
}

impl Masks {
    /// Finds the masks of all images in `folder`; every one of them is checked for its size, and read once.
    ///
    /// # Errors
    /// The folder cannot be read or has no mask of any image, or a mask has another size than its image.
    pub fn open(folder: &Path, dataset: &Recording) -> Result<Self, Error> {
        std::fs::read_dir(folder).map_err(|e| Error::io("read", folder, e))?;
        let mut files = BTreeMap::new();
        let mut hash = Sha256::new();
        for entry in &dataset.images {
            let names = names(entry);
            let Some(path) = names.iter().map(|n| folder.join(n)).find(|p| p.is_file()) else { continue };
            check_size(&path, dataset)?;
            let bytes = std::fs::read(&path).map_err(|e| Error::io("read", &path, e))?;
            hash.update(entry.frame_id.0.to_le_bytes());
            hash.update(Sha256::digest(&bytes));
            files.insert(entry.frame_id, path);
        }
        if files.is_empty() {
            let expected = dataset.images.first().map_or_else(String::new, |e| names(e).join(" or "));
            return Err(Error::Usage {
                what: format!(
                    "{} has no mask of any of the {} images",
                    folder.display(),
                    dataset.images.len()
                ),
                hint: format!("masks are called as their images are: {expected} for the first one"),
            });
        }
        let sha256 = vidar_hub::hex(&hash.finalize());
        Ok(Self { files, sha256, images: dataset.images.len() })
    }

    /// SHA-256 of the masks and of which images they are of.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// In words, for the plan.
    pub fn words(&self) -> String {
        format!("of {} of {} images; what is black in them is ignored", self.files.len(), self.images)
    }

    /// The mask of an image in its own pixels, `true` where it is ignored; `None` where the image is used whole.
    ///
    /// # Errors
    /// The file cannot be decoded.
    pub fn load(&self, frame: FrameId) -> Result<Option<Image<bool>>, DatasetError> {
        let Some(path) = self.files.get(&frame) else { return Ok(None) };
        let ignored = match read_image(path)? {
            FrameImage::Gray8(image) => image.map(|v| *v == 0),
            FrameImage::Gray16(image) => image.map(|v| *v == 0),
            FrameImage::Rgb8(image) => image.map(|v| *v == [0; 3]),
        };
        Ok(Some(ignored))
    }
}

/// Names that the mask of an image may have, the preferred one first.
fn names(entry: &ImageEntry) -> Vec<String> {
    let Some(file) = entry.location.as_file() else { return vec![format!("{:06}.png", entry.frame_id.0)] };
    let text = |part: Option<&std::ffi::OsStr>| part.and_then(|p| p.to_str()).unwrap_or_default().to_owned();
    vec![format!("{}.png", text(file.file_name())), format!("{}.png", text(file.file_stem()))]
}

fn check_size(path: &Path, dataset: &Recording) -> Result<(), Error> {
    let (found_width, found_height) = read_size(path)?;
    let Some(camera) = dataset.rig.camera(dataset.camera) else { return Ok(()) };
    let (expected_width, expected_height) = (camera.model.width(), camera.model.height());
    if (found_width, found_height) == (expected_width, expected_height) {
        return Ok(());
    }
    Err(Error::Usage {
        what: format!(
            "the mask {} is {found_width}x{found_height}, its image {expected_width}x{expected_height}",
            path.display()
        ),
        hint: "masks are made of the images as they were captured, before they are undistorted or reduced"
            .into(),
    })
}
