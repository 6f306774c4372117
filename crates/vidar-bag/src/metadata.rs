//! `metadata.yaml` of a ROS 2 bag: which files belong to the recording, and how they are compressed.

use crate::error::BagError;
use serde::Deserialize;
use std::path::{Component, Path, PathBuf};

/// Largest description; a real one has about 1 kB and some hundred bytes per topic.
const MAX_BYTES: u64 = 4 << 20;

#[derive(Deserialize)]
struct Document {
    rosbag2_bagfile_information: Information,
}

#[derive(Deserialize)]
struct Information {
    relative_file_paths: Vec<String>,
    #[serde(default)]
    compression_format: String,
    #[serde(default)]
    compression_mode: String,
}

/// The files of a ROS 2 bag.
pub(crate) struct Metadata {
    pub files: Vec<PathBuf>,
    /// Each message is compressed with zstd.
    pub messages_are_compressed: bool,
}

/// Reads the description in `folder`; `None` where there is none.
pub(crate) fn read(folder: &Path) -> Result<Option<Metadata>, BagError> {
    let path = folder.join("metadata.yaml");
    if !path.is_file() {
        return Ok(None);
    }
    let failed = |source| BagError::Io { path: path.clone(), source };
    let length = std::fs::metadata(&path).map_err(failed)?.len();
    if length > MAX_BYTES {
        return Err(BagError::TooLarge {
            path,
            what: "bytes of the description",
            found: length,
            limit: MAX_BYTES,
        });
    }
    let text = std::fs::read_to_string(&path).map_err(failed)?;
    parse(&text, folder, &path).map(Some)
}

fn parse(text: &str, folder: &Path, path: &Path) -> Result<Metadata, BagError> {
    let malformed = |found: String| BagError::Malformed {
        path: path.to_path_buf(),
        offset: 0,
        found,
        expected: "rosbag2_bagfile_information with relative_file_paths".into(),
    };
    let document: Document = serde_saphyr::from_str(text).map_err(|e| malformed(e.to_string()))?;
    let about = document.rosbag2_bagfile_information;
    let mode = about.compression_mode.to_ascii_uppercase();
    if mode == "FILE" && !about.compression_format.is_empty() {
        return Err(BagError::Unsupported {
            path: path.to_path_buf(),
            found: format!("whole files are compressed ({})", vidar_core::printable(&about.compression_format)),
            way: "messages cannot be reached in such a file; `zstd -d FILE` unpacks it, then open the folder without metadata.yaml"
                .into(),
        });
    }
    let messages_are_compressed = mode == "MESSAGE" && about.compression_format == "zstd";
    let mut files = Vec::new();
    for name in about.relative_file_paths {
        let relative = Path::new(&name);
        // Older writers put the folder's own name before the file's; nothing outside of the folder is ever opened.
        if relative.components().any(|c| !matches!(c, Component::Normal(_) | Component::CurDir)) {
            return Err(malformed(format!("the path {:?}", vidar_core::printable(&name))));
        }
        let inside = folder.join(relative);
        let beside = relative.file_name().map(|n| folder.join(n));
        files.push(if inside.is_file() { inside } else { beside.unwrap_or(inside) });
    }
    if files.is_empty() {
        return Err(malformed("no files".into()));
    }
    Ok(Metadata { files, messages_are_compressed })
}
