//! The map of a place that one recording leaves for the next: `odometry/map.cbor` in the folder of `vidar odometry` and `vidar run`, and `input.map`.

use crate::config::Config;
use crate::error::Error;
use crate::run_folder::RunFolder;
use crate::system::read_up_to;
use std::path::{Path, PathBuf};
use vidar_core::{Timestamp, Warning};
use vidar_odometry::SavedMap;

/// Where it lies in the folder: CBOR (RFC 8949) of [`SavedMap`].
pub(crate) const FILE: &str = "odometry/map.cbor";

/// Largest map that is read, bytes: 2000 keyframes with 150 landmarks of 60 bytes each are 18 MB.
const MAX_BYTES: u64 = 128 << 20;

/// The map that `input.map` names.
#[derive(Clone, Debug)]
pub(crate) struct EarlierMap {
    /// The file.
    pub path: PathBuf,
    /// SHA-256 of its bytes.
    pub sha256: String,
    /// The keyframes.
    pub map: SavedMap,
}

impl EarlierMap {
    /// Reads it; `None` where none is named.
    ///
    /// # Errors
    /// [`Error::NotAMap`] where the file cannot be read, is no map, or is of another version.
    pub fn of(config: &Config) -> Result<Option<Self>, Error> {
        let named = Path::new(&config.input.map);
        if named.as_os_str().is_empty() {
            return Ok(None);
        }
        let path = if named.is_dir() { named.join(FILE) } else { named.to_owned() };
        let wrong = |reason: String| Error::NotAMap { path: path.clone(), reason };
        let bytes = read_up_to(&path, MAX_BYTES).map_err(|e| wrong(e.to_string()))?;
        let map = parse(&bytes).map_err(wrong)?;
        Ok(Some(Self { sha256: vidar_hub::sha256_hex(&bytes), map, path }))
    }
}

fn parse(bytes: &[u8]) -> Result<SavedMap, String> {
    let map: SavedMap = ciborium::from_reader(bytes).map_err(|e| format!("no map of VIDAR: {e}"))?;
    match map.fault() {
        Some(fault) => Err(fault),
        None if map.is_empty() => Err("it has no keyframes".into()),
        None => Ok(map),
    }
}

/// Writes the map that this recording leaves; its name, where there is one.
pub(crate) fn write(folder: &RunFolder, map: &SavedMap) -> Result<Option<(&'static str, u64)>, Error> {
    if map.is_empty() {
        return Ok(None);
    }
    let mut bytes = Vec::new();
    ciborium::into_writer(map, &mut bytes)
        .map_err(|e| Error::io("write", &folder.path().join(FILE), std::io::Error::other(e.to_string())))?;
    Ok(Some((FILE, folder.write(FILE, &bytes)?)))
}

/// How the map of an earlier recording served.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct MapUse {
    /// Its file.
    pub file: PathBuf,
    /// First image whose live pose is in the world of the map, ns; poses before it were taken there with it.
    pub found_live_ns: Option<i64>,
    /// Landmarks of the map that the adjusted keyframes show, each counted once per keyframe; `None` where two keyframes did not agree.
    pub matches: Option<usize>,
}

impl MapUse {
    /// Whether the final poses are in the world of the map.
    pub fn is_found(&self) -> bool {
        self.found_live_ns.is_some() || self.matches.is_some()
    }

    pub(super) fn warning(&self) -> Warning {
        let file = self.file.display();
        if !self.is_found() {
            let text =
                format!("the place of {file} was not recognised: the poses are in a world of their own");
            let hint = "show something that the earlier recording shows, from within half to twice its distance, and turn less than \
                        30° away from its direction";
            return Warning::degraded("map-not-found", text).hint(hint);
        }
        let live = match self.found_live_ns.map(Timestamp::from_nanos) {
            Some(time) => format!("recognised live at {time} s"),
            None => "recognised after the end only, the live poses are in a world of their own".into(),
        };
        let shown =
            self.matches.map_or(String::new(), |n| format!("; {n} observations of its landmarks agree"));
        Warning::new("map-found", format!("the poses are in the world of {file}: {live}{shown}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_that_are_no_map_are_refused_with_a_reason() {
        let empty = r#"{"version":1,"keyframes":[]}"#;
        let map: SavedMap = serde_json::from_str(empty).unwrap();
        let mut bytes = Vec::new();
        ciborium::into_writer(&map, &mut bytes).unwrap();
        assert_eq!(parse(&bytes), Err("it has no keyframes".into()));
        assert!(parse(&bytes[..bytes.len() - 1]).unwrap_err().contains("no map"));
        // A list that claims 2^60 entries is not allocated.
        let claims = [0x9b, 0x10, 0, 0, 0, 0, 0, 0, 0].repeat(40);
        assert!(parse(&claims).is_err());
        assert!(parse(&[0x81; 100_000]).is_err(), "nested without end");
    }
}
