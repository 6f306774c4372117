//! One message for each thing that is often given by mistake: what it is, and the nearest way.

use crate::error::{DatasetError, io_error};
use std::io::Read;
use std::path::Path;

/// Bytes that tell one kind of file from another.
const HEAD_BYTES: u64 = 512;

/// The first bytes of a file.
pub(crate) fn head_of(path: &Path) -> Result<Vec<u8>, DatasetError> {
    let text = path.to_string_lossy();
    if let Some((scheme, _)) = text.split_once(":/").filter(|(s, _)| is_scheme(s)) {
        let found = format!("a URL ({scheme}); recordings are read from this machine's disks only");
        return Err(wrong(path, found, "download it first, then give the file"));
    }
    let file = std::fs::File::open(path).map_err(io_error(path))?;
    let mut head = Vec::new();
    file.take(HEAD_BYTES).read_to_end(&mut head).map_err(io_error(path))?;
    Ok(head)
}

fn is_scheme(text: &str) -> bool {
    // A drive letter of Windows has one.
    text.len() > 1 && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'+')
}

/// Why a file with these first bytes is no recording.
pub(crate) fn describe(path: &Path, head: &[u8]) -> DatasetError {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let (found, way) = match head {
        [] => ("an empty file (0 bytes)", "the copy failed or the recorder never wrote; copy it again"),
        // The first file's flags: bit 0 says that a password is needed.
        [b'P', b'K', 3, 4, _, _, flags, ..] if flags & 1 == 1 => {
            ("an encrypted zip archive", "unpack it with its password, then give the folder or file inside")
        }
        [b'P', b'K', 3 | 5, ..] => ("a zip archive", "unpack it, then give the folder or file inside"),
        [0x1f, 0x8b, ..] | [0x28, 0xb5, 0x2f, 0xfd, ..] | [0xfd, b'7', b'z', ..] | [b'B', b'Z', b'h', ..] => {
            ("a compressed file", "unpack it (gunzip, unzstd, xz -d, tar -x), then give what is inside")
        }
        [b'7', b'z', 0xbc, 0xaf, ..] | [b'R', b'a', b'r', b'!', ..] => {
            ("an archive", "unpack it, then give the folder or file inside")
        }
        [0x89, b'P', b'N', b'G', ..] | [0xff, 0xd8, 0xff, ..] => {
            ("one image", "give the folder that holds all images; `vidar depth IMAGE` estimates depth of one")
        }
        head if is_brand(head, AVIF) => (
            "an AVIF image, which is not decoded",
            "convert it to JPEG or PNG; a folder of such images is a recording",
        ),
        head if is_picture(head) => (
            "an HEIC image, which is not decoded",
            "export as JPEG: on a phone choose \"most compatible\" as the camera's format",
        ),
        [0x1a, 0x45, 0xdf, 0xa3, ..] => (
            "a Matroska or WebM video",
            "repack it without loss: ffmpeg -i IN -c copy OUT.mp4 (or --decoder ffmpeg)",
        ),
        [b'R', b'I', b'F', b'F', ..] => (
            "an AVI video or a sound",
            "convert it: ffmpeg -i IN -c:v libx264 -crf 16 OUT.mp4 (or --decoder ffmpeg)",
        ),
        head if head.starts_with(b"#ROSBAG") => {
            ("a ROS bag of a version before 2.0", "`rosbag migrate` of an old ROS converts it")
        }
        head if head.starts_with(b"ply\n") || head.starts_with(b"glTF") => {
            ("a point cloud or mesh", "VIDAR makes such files; give the recording")
        }
        head if head.starts_with(b"\x89HDF") => {
            ("an HDF5 file", "export images and IMU as a folder or a bag")
        }
        head if name.ends_with(".csv")
            || name.ends_with(".txt")
            || name.ends_with(".yaml")
            || name.ends_with(".json") =>
        {
            let _ = head;
            ("a text file", "give the folder that holds it together with the images")
        }
        _ if name.ends_with(".bag") || name.ends_with(".mcap") || name.ends_with(".db3") => (
            "named as a bag, but its first bytes are not those of one",
            "it is truncated at the start, or encrypted; copy it again",
        ),
        _ => (
            "a file of a kind that is not known",
            "give a bag (.bag, .mcap, .db3), or a folder: EuRoC, TUM RGB-D, 7-Scenes, images",
        ),
    };
    wrong(path, found.into(), way)
}

/// Why a folder with these entries is no recording, where they show it.
pub(crate) fn describe_folder(path: &Path, names: &[String]) -> Option<DatasetError> {
    let ending_with = |endings: &[&str]| -> Vec<&str> {
        let is_one = |n: &&str| endings.iter().any(|e| n.to_ascii_lowercase().ends_with(e));
        names.iter().map(String::as_str).filter(|n| !n.starts_with('.')).filter(is_one).collect()
    };
    let several = |files: &[&str]| {
        let more = if files.len() > 3 { ", …" } else { "" };
        format!("{}{more}", files[..files.len().min(3)].join(", "))
    };
    let (pictures, videos) = (ending_with(&[".heic", ".heif"]), ending_with(&[".mp4", ".mov", ".m4v"]));
    let others = ending_with(&[".avif", ".webp", ".tif", ".tiff", ".bmp", ".jxl", ".jp2"]);
    if pictures.is_empty() && videos.is_empty() && !others.is_empty() {
        let found = format!("{} images of a kind that is not decoded ({})", others.len(), several(&others));
        return Some(wrong(path, found, "convert them to PNG or JPEG, under the same names"));
    }
    let archives = ending_with(&[".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".xz", ".bz2", ".zst"]);
    let (found, way) = match (pictures.len(), videos.len(), archives.len()) {
        (1.., 0, _) => (
            format!("{} HEIC images ({}), which are not decoded", pictures.len(), several(&pictures)),
            "export them as JPEG: on a phone choose \"most compatible\" as the camera's format",
        ),
        (_, 2.., _) => (
            format!("{} videos ({})", videos.len(), several(&videos)),
            "each is a recording of its own: give one of them",
        ),
        (0, 0, 1..) => (
            format!("a folder with an archive ({})", several(&archives)),
            "unpack it, then give the folder or file inside",
        ),
        _ => return None,
    };
    Some(wrong(path, found, way))
}

/// Whether a file may be a video that the user's own program reads: Matroska and WebM, AVI, MPEG's streams, and containers that begin
/// like nothing known.
pub(crate) fn may_be_video(head: &[u8]) -> bool {
    let is_text = !head.is_empty() && head.iter().all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace());
    !head.is_empty() && !is_text && !is_picture(head) && !head.starts_with(b"PK")
}

const AVIF: &[&[u8; 4]] = &[b"avif", b"avis"];

/// Whether an ISO media file holds pictures instead of a movie.
pub(crate) fn is_picture(head: &[u8]) -> bool {
    is_brand(head, AVIF) || is_brand(head, &[b"heic", b"heix", b"mif1", b"msf1", b"heif"])
}

/// Whether an ISO media file states one of these brands.
fn is_brand(head: &[u8], brands: &[&[u8; 4]]) -> bool {
    head.get(4..8) == Some(b"ftyp") && head.get(8..12).is_some_and(|b| brands.iter().any(|k| b == *k))
}

pub(crate) fn wrong(path: &Path, found: String, way: &str) -> DatasetError {
    DatasetError::WrongThing { path: path.to_path_buf(), found, way: way.to_string() }
}
