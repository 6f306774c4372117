//! A reference file and its entry in the manifest.

use crate::config::{Da3Config, Variant, json};
use crate::error::Da3Error;
use crate::model::backbone::ReferenceStrategy;
use crate::preprocess::normalise;
use crate::weights::synthetic::image_u8;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use vidar_nn::Checkpoint;

/// A manifest lists a few dozen files; a larger file is something else.
const MAX_MANIFEST_BYTES: u64 = 16 << 20;
/// Larger inputs than any reference has.
const MAX_SIDE: usize = 8192;
const MAX_VIEWS: usize = 1024;

/// What a reference file shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// The network without cameras.
    Free,
    /// The network with given cameras, and inference around it.
    Posed,
    /// The nested model.
    Nested,
}

/// A reference file, open.
pub struct Golden {
    path: PathBuf,
    tensors: Checkpoint,
    pub(super) kind: Kind,
    pub(super) views: usize,
    pub(super) rows: usize,
    pub(super) columns: usize,
    pub(super) strategy: ReferenceStrategy,
    pub(super) entry: Entry,
}

#[derive(Deserialize)]
struct Manifest {
    files: BTreeMap<String, serde_json::Value>,
}

/// The fields of an entry that matter here.
#[derive(Deserialize)]
pub(super) struct Entry {
    kind: String,
    #[serde(default)]
    model: Option<String>,
    #[serde(default)]
    config: Option<serde_json::Value>,
    #[serde(default)]
    views: usize,
    #[serde(default, rename = "H")]
    rows: usize,
    #[serde(default, rename = "W")]
    columns: usize,
    #[serde(default)]
    input: String,
    #[serde(default)]
    kwargs: Arguments,
    /// Rows and columns of the images before preprocessing.
    #[serde(default)]
    pub source_hw: Option<[usize; 2]>,
    #[serde(default)]
    pub process_res: Option<usize>,
    /// Set where the official code raises.
    #[serde(default)]
    pub api_true_error: Option<String>,
    /// By output: largest difference between the official code in f32 and in f64 over the output's deviation.
    #[serde(default)]
    pub f32_vs_f64: BTreeMap<String, Rounding>,
}

#[derive(Default, Deserialize)]
struct Arguments {
    ref_view_strategy: Option<ReferenceStrategy>,
}

#[derive(Deserialize)]
pub(super) struct Rounding {
    pub max_abs_over_std: f64,
}

impl Golden {
    /// Opens a file that the `manifest.json` beside it describes.
    pub fn open(path: &Path) -> Result<Self, Da3Error> {
        let place = path.display().to_string();
        let bad = |reason: String| Da3Error::BadGolden { place: place.clone(), reason };
        let manifest = path.with_file_name("manifest.json");
        let text = read_text(&manifest)?;
        let manifest: Manifest =
            serde_json::from_str(&text).map_err(|e| bad(format!("{}: {e}", manifest.display())))?;
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let entry =
            manifest.files.get(&name).ok_or_else(|| bad("the manifest has no entry for it".into()))?;
        let entry: Entry = serde_json::from_value(entry.clone())
            .map_err(|e| bad(format!("its entry in the manifest: {e}")))?;
        let kind = match entry.kind.as_str() {
            k if k.starts_with("net forward") => Kind::Free,
            k if k.starts_with("pose-conditioned") => Kind::Posed,
            k if k.starts_with("NestedDepthAnything3Net") => Kind::Nested,
            k => return Err(bad(format!("{k:?} is not a run of a network"))),
        };
        let (views, rows, columns) = (entry.views, entry.rows, entry.columns);
        let is_small = (1..=MAX_VIEWS).contains(&views) && rows <= MAX_SIDE && columns <= MAX_SIDE;
        if !is_small {
            return Err(bad(format!("{views} views of {columns}x{rows}")));
        }
        let strategy = entry.kwargs.ref_view_strategy.unwrap_or_default();
        let tensors = Checkpoint::open(path)?;
        Ok(Self { path: path.to_path_buf(), tensors, kind, views, rows, columns, strategy, entry })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The network that the reference is of.
    pub fn config(&self) -> Result<Da3Config, Da3Error> {
        let place = self.path.display().to_string();
        if let Some(config) = &self.entry.config {
            return json::parse(&config.to_string(), &place);
        }
        let name = self.entry.model.as_deref().unwrap_or_default();
        let unknown = || Da3Error::BadGolden { place, reason: format!("unknown model {name:?}") };
        Ok(Variant::from_name(name).ok_or_else(unknown)?.config())
    }

    /// Names of all tensors.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.names()
    }

    /// Whether there is a tensor of that name, thinned or not.
    pub(super) fn has(&self, name: &str) -> bool {
        self.names().any(|n| n == name || n.strip_prefix(name).is_some_and(|rest| rest.starts_with(".s")))
    }

    /// Shape and numbers of a tensor.
    pub(super) fn tensor(&self, name: &str) -> Result<(Vec<usize>, Vec<f64>), Da3Error> {
        let tensor = self.tensors.tensor(name)?;
        Ok((tensor.shape.to_vec(), tensor.to_f64()?))
    }

    /// Bytes of a tensor.
    pub(super) fn bytes(&self, name: &str) -> Result<Vec<u8>, Da3Error> {
        Ok(self.tensors.tensor(name)?.to_u8()?)
    }

    /// The reference view that was chosen, where the file says so.
    pub(super) fn reference(&self) -> Result<Option<usize>, Da3Error> {
        if !self.tensors.contains("ref_idx") {
            return Ok(None);
        }
        let index = self.tensors.tensor("ref_idx")?.to_i64()?.first().copied().unwrap_or(0);
        Ok(usize::try_from(index).ok().filter(|i| *i < self.views))
    }

    /// The network's input, `[S, 3, H, W]`: from the file, or made from the seeds of the entry.
    pub(super) fn pixels(&self) -> Result<Vec<f32>, Da3Error> {
        if self.tensors.contains("input") {
            let tensor = self.tensors.tensor("input")?;
            let expected = [self.views, 3, self.rows, self.columns];
            if tensor.shape != expected {
                let reason = format!("input has shape {:?}, expected {expected:?}", tensor.shape);
                return Err(Da3Error::BadGolden { place: self.path.display().to_string(), reason });
            }
            return Ok(tensor.to_f32()?);
        }
        let seeds =
            self.seeds().filter(|_| self.entry.input.starts_with("normalize(image_u8")).ok_or_else(|| {
                let reason = format!("its input is not in the file: {}", self.entry.input);
                Da3Error::BadGolden { place: self.path.display().to_string(), reason }
            })?;
        Ok(seeds.iter().flat_map(|s| normalise(&image_u8(*s, self.columns, self.rows))).collect())
    }

    /// The seeds of the images, `… for seed in [1, 2]`, one a view.
    pub(super) fn seeds(&self) -> Option<Vec<u64>> {
        let (_, list) = self.entry.input.split_once("for seed in [")?;
        let (list, _) = list.split_once(']')?;
        let seeds: Vec<u64> = list.split(',').map(|s| s.trim().parse().ok()).collect::<Option<_>>()?;
        (seeds.len() == self.views).then_some(seeds)
    }
}

fn read_text(path: &Path) -> Result<String, Da3Error> {
    let io = |source| Da3Error::Io { path: path.to_path_buf(), source };
    let bytes = std::fs::metadata(path).map_err(io)?.len();
    if bytes > MAX_MANIFEST_BYTES {
        let place = path.display().to_string();
        return Err(Da3Error::ConfigTooLarge { place, bytes, max: MAX_MANIFEST_BYTES });
    }
    std::fs::read_to_string(path).map_err(io)
}
