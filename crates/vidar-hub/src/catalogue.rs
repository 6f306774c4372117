//! The official checkpoints of Depth Anything 3 on the hub.
//!
//! Sizes and hashes identify the official files: any other file under their name is refused. Where the hash of a
//! file is not known here, the one that the hub announces (`X-Linked-ETag`) is used, and the record states this.
//! `-1.1` checkpoints were retrained after a training bug; their predecessors are kept for comparisons.

use crate::error::HubError;
use crate::licence::Licence;
use serde::Serialize;

/// What a checkpoint can estimate from images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ability {
    /// Depth and confidence, consistent over many views, up to one scale.
    MultiViewDepth,
    /// Poses and intrinsics of the cameras, or depth for known cameras.
    Cameras,
    /// Depth of one image in metres, given the focal length.
    MetricDepth,
    /// Depth of one image, up to a scale.
    MonocularDepth,
    /// Which pixels are sky.
    Sky,
}

impl Ability {
    /// As text.
    pub fn words(self) -> &'static str {
        match self {
            Self::MultiViewDepth => "multi-view depth",
            Self::Cameras => "cameras",
            Self::MetricDepth => "metric depth",
            Self::MonocularDepth => "single-view depth",
            Self::Sky => "sky",
        }
    }
}

/// One official file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OfficialFile {
    /// Name in the repository and next to the weights.
    pub name: &'static str,
    /// Its length, where known.
    pub bytes: Option<u64>,
    /// Its SHA-256 as lower-case hexadecimal digits, where known.
    pub sha256: Option<&'static str>,
}

/// Name of the file that holds the weights.
pub const WEIGHTS: &str = "model.safetensors";
/// Name of the file that names the architecture.
pub const CONFIG: &str = "config.json";

/// One official checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Checkpoint {
    /// Name as the user chooses it (`da3-small`).
    pub name: &'static str,
    /// Repository on the hub.
    pub repo: &'static str,
    /// The commit whose files are described here.
    pub revision: &'static str,
    /// `model_name` of its `config.json`.
    pub architecture: &'static str,
    /// Licence of its weights, as the authors' README has it.
    pub licence: Licence,
    /// Parameters that the file holds.
    pub parameters: u64,
    /// Tensors that the file holds.
    pub tensors: usize,
    /// `config.json`, then the weights.
    pub files: [OfficialFile; 2],
    /// What it can estimate.
    pub abilities: &'static [Ability],
    /// Advice on when to choose it.
    pub note: &'static str,
}

impl Checkpoint {
    /// The file of weights.
    pub fn weights(&self) -> &OfficialFile {
        &self.files[1]
    }

    /// Length of all files, bytes.
    pub fn bytes(&self) -> u64 {
        self.files.iter().filter_map(|f| f.bytes).sum()
    }

    /// Its page on a hub.
    pub fn page(&self, endpoint: &str) -> String {
        format!("{}/{}", endpoint.trim_end_matches('/'), self.repo)
    }

    /// Address of one of its files on a hub: `{endpoint}/{repo}/resolve/{revision}/{file}`.
    pub fn url(&self, endpoint: &str, revision: &str, file: &str) -> String {
        format!("{}/resolve/{revision}/{file}", self.page(endpoint))
    }
}

const ANY_VIEW: &[Ability] = &[Ability::MultiViewDepth, Ability::Cameras, Ability::MonocularDepth];
const METRIC: &[Ability] = &[Ability::MetricDepth, Ability::Sky];
const MONO: &[Ability] = &[Ability::MonocularDepth, Ability::Sky];
const NESTED: &[Ability] =
    &[Ability::MultiViewDepth, Ability::Cameras, Ability::MonocularDepth, Ability::MetricDepth, Ability::Sky];

const fn config(bytes: Option<u64>, sha256: Option<&'static str>) -> OfficialFile {
    OfficialFile { name: CONFIG, bytes, sha256 }
}

const fn weights(bytes: u64, sha256: Option<&'static str>) -> OfficialFile {
    OfficialFile { name: WEIGHTS, bytes: Some(bytes), sha256 }
}

/// The official checkpoints, smallest first, newest before its predecessor.
pub const CHECKPOINTS: &[Checkpoint] = &[
    Checkpoint {
        name: "da3-small",
        repo: "depth-anything/DA3-SMALL",
        revision: "e08cab65ca0ec38e7826075418411ab90cab4da3",
        architecture: "da3-small",
        licence: Licence::Apache2,
        parameters: 34_299_463,
        tensors: 437,
        files: [
            config(Some(1_202), Some("a486e29e82b7ab4a7d4cefc1ea4526cfe2ae438a572c8ca98917cfbcde7447d2")),
            weights(137_248_940, Some("364492e38a3a06d221ac75da7f6621ada3f2361cd24fde11ba79091e9f40efcf")),
        ],
        abilities: ANY_VIEW,
        note: "the default; runs anywhere",
    },
    Checkpoint {
        name: "da3-base",
        repo: "depth-anything/DA3-BASE",
        revision: "f4a6c9b3c95e41c82048423d3493a81ec3fa810e",
        architecture: "da3-base",
        licence: Licence::Apache2,
        parameters: 135_366_599,
        tensors: 437,
        files: [
            config(Some(1_205), Some("5e34115ebc17bd2d8d43033c5f72e9446ac8833fd61d3fa160b7e67e0bb5b7b5")),
            weights(541_518_028, Some("e01067dc1659613083d9145a9a2547ccdbe6ccbbf83c4fe7b3e8a4e2bdae78b5")),
        ],
        abilities: ANY_VIEW,
        note: "the best that may be used commercially",
    },
    Checkpoint {
        name: "da3-metric-large",
        repo: "depth-anything/DA3METRIC-LARGE",
        revision: "4010e39f3634a45bc60553321fb49fb760bd594e",
        architecture: "da3metric-large",
        licence: Licence::Apache2,
        parameters: 334_171_394,
        tensors: 406,
        files: [
            config(Some(847), Some("a336f3e76fe375aaae17a9aed9130c9f2aa061535d317ec57dcb2f1f02e1dd53")),
            weights(1_336_734_448, Some("bbea5b0b3ee389849cffa7ddae89de064a90abd2b055fc5aa99aac68db324776")),
        ],
        abilities: METRIC,
        note: "each image separately; no confidence, no cameras; metres need the focal length",
    },
    Checkpoint {
        name: "da3-mono-large",
        repo: "depth-anything/DA3MONO-LARGE",
        revision: "f465978e618db8cc79c83b8bbf24964857db1875",
        architecture: "da3mono-large",
        licence: Licence::Apache2,
        parameters: 334_171_394,
        tensors: 406,
        files: [config(None, None), weights(1_336_734_448, None)],
        abilities: MONO,
        note: "each image separately; no confidence, no cameras",
    },
    Checkpoint {
        name: "da3-large-1.1",
        repo: "depth-anything/DA3-LARGE-1.1",
        revision: "0e109ae307c5982f319a67cf6f9f99ccdc0ec97c",
        architecture: "da3-large",
        licence: Licence::CcByNc4,
        parameters: 410_941_767,
        tensors: 637,
        files: [
            config(Some(1_213), Some("744dcaf53859490ed92fc6cb98d68d3daf624b8c54533aaf604bdb53f06321f5")),
            weights(1_643_843_860, Some("739905c423cf0d6ccaf9e61a8401d82ba1ac32d7f4d3ee6dca8f92b377633f64")),
        ],
        abilities: ANY_VIEW,
        note: "its page on the hub is reported to state Apache-2.0, the authors' README states CC BY-NC 4.0; \
               the stricter one is taken",
    },
    Checkpoint {
        name: "da3-large",
        repo: "depth-anything/DA3-LARGE",
        revision: "c54c26b16ec04d218e8d584ecf4bce082a9fcc20",
        architecture: "da3-large",
        licence: Licence::CcByNc4,
        parameters: 410_941_767,
        tensors: 637,
        files: [
            config(None, None),
            weights(1_643_843_860, Some("eaf2ae06df55889ad23eb245c82e2dd2a30c0cbf7e3d873a118fa5ed27a3e421")),
        ],
        abilities: ANY_VIEW,
        note: "superseded by da3-large-1.1",
    },
    Checkpoint {
        name: "da3-giant-1.1",
        repo: "depth-anything/DA3-GIANT-1.1",
        revision: "72ee9f89ce4e50d704e9d55ee9c646ec8dc25a19",
        architecture: "da3-giant",
        licence: Licence::CcByNc4,
        parameters: 1_355_674_125,
        tensors: 971,
        files: [config(None, None), weights(5_422_814_644, None)],
        abilities: ANY_VIEW,
        note: "35.6 M of its parameters are a Gaussian head that VIDAR does not use",
    },
    Checkpoint {
        name: "da3-giant",
        repo: "depth-anything/DA3-GIANT",
        revision: "7cd62ae9315b9dff094d2d300e4ad012640607dd",
        architecture: "da3-giant",
        licence: Licence::CcByNc4,
        parameters: 1_355_674_125,
        tensors: 971,
        files: [
            config(Some(1_880), None),
            weights(5_422_814_644, Some("1e47a08338ca73a6d6a21d37fd060b26b993b672bc6ddf6295fe474df2592001")),
        ],
        abilities: ANY_VIEW,
        note: "superseded by da3-giant-1.1",
    },
    Checkpoint {
        name: "da3-nested-giant-large-1.1",
        repo: "depth-anything/DA3NESTED-GIANT-LARGE-1.1",
        revision: "b2359bdf726fb44ef62acca04d629dcf158053e7",
        architecture: "da3nested-giant-large",
        licence: Licence::CcByNc4,
        parameters: 1_689_845_519,
        tensors: 1_377,
        files: [
            config(None, Some("09adf89474017e717bc05aa86fd3a378708ba8914b036d61874eced328069468")),
            weights(6_759_558_100, Some("8ebe871a022ed58d2fc8fdfb2ebdb31d57b60fe39611c849095851a7b7c6020c")),
        ],
        abilities: NESTED,
        note: "giant estimates the shape, metric-large the scale",
    },
    Checkpoint {
        name: "da3-nested-giant-large",
        repo: "depth-anything/DA3NESTED-GIANT-LARGE",
        revision: "8615eefb62f2db4f8d6ebaa59160086981672829",
        architecture: "da3nested-giant-large",
        licence: Licence::CcByNc4,
        parameters: 1_689_845_519,
        tensors: 1_377,
        files: [
            config(None, Some("09adf89474017e717bc05aa86fd3a378708ba8914b036d61874eced328069468")),
            weights(6_759_558_100, Some("8899faf998dedbc230261ab736fa57015280727399429122d44d4f9e7aac2ddd")),
        ],
        abilities: NESTED,
        note: "superseded by da3-nested-giant-large-1.1",
    },
];

/// The checkpoint of that name. `DA3-SMALL`, `depth-anything/DA3-SMALL` and `da3metric-large` are accepted, too.
pub fn find(name: &str) -> Result<&'static Checkpoint, HubError> {
    let plain = |text: &str| {
        let last = text.rsplit('/').next().unwrap_or(text).to_lowercase();
        last.replace(['-', '_'], "")
    };
    CHECKPOINTS.iter().find(|c| plain(c.name) == plain(name) || plain(c.repo) == plain(name)).ok_or_else(
        || {
            let known = CHECKPOINTS.iter().map(|c| c.name).collect::<Vec<_>>().join(", ");
            HubError::UnknownModel { name: name.to_owned(), known }
        },
    )
}

/// The official checkpoints whose weights have this length; usually a model and its predecessor.
pub fn of_size(bytes: u64) -> impl Iterator<Item = &'static Checkpoint> {
    CHECKPOINTS.iter().filter(move |c| c.weights().bytes == Some(bytes))
}

/// The official checkpoint whose weights have this SHA-256.
pub fn of_hash(sha256: &str) -> Option<&'static Checkpoint> {
    CHECKPOINTS.iter().find(|c| c.weights().sha256 == Some(sha256))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_checkpoint_is_found_by_its_names_and_only_by_them() {
        for checkpoint in CHECKPOINTS {
            assert_eq!(find(checkpoint.name).unwrap(), checkpoint);
            assert_eq!(find(checkpoint.repo).unwrap(), checkpoint);
            assert_eq!(find(&checkpoint.name.to_uppercase()).unwrap(), checkpoint);
        }
        assert_eq!(find("da3metric-large").unwrap().name, "da3-metric-large");
        assert_eq!(find("DA3NESTED-GIANT-LARGE-1.1").unwrap().name, "da3-nested-giant-large-1.1");
        let unknown = find("da3-huge").unwrap_err().to_string();
        assert!(unknown.contains("da3-huge") && unknown.contains("da3-small"), "{unknown}");
    }

    #[test]
    fn hashes_and_sizes_are_well_formed_and_distinguish_checkpoints() {
        let mut seen = Vec::new();
        for checkpoint in CHECKPOINTS {
            assert_eq!([checkpoint.files[0].name, checkpoint.files[1].name], [CONFIG, WEIGHTS]);
            assert_eq!(checkpoint.revision.len(), 40, "{}", checkpoint.name);
            for hash in checkpoint.files.iter().filter_map(|f| f.sha256) {
                assert_eq!(hash.len(), 64, "{}", checkpoint.name);
                assert!(hash.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b)));
            }
            // 32-bit floats and a header of some hundred bytes per tensor.
            let header = checkpoint.weights().bytes.unwrap() - 4 * checkpoint.parameters;
            assert!(
                (80..200).contains(&(header / checkpoint.tensors as u64)),
                "{}: {header}",
                checkpoint.name
            );
            seen.extend(checkpoint.weights().sha256);
        }
        let count = seen.len();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len(), count);
        assert_eq!(of_hash(seen[0]).map(|c| c.weights().sha256), Some(Some(seen[0])));
        assert_eq!(
            of_size(1_643_843_860).map(|c| c.name).collect::<Vec<_>>(),
            ["da3-large-1.1", "da3-large"]
        );
    }

    #[test]
    fn addresses_have_the_hubs_layout() {
        let small = find("da3-small").unwrap();
        assert_eq!(
            small.url("https://huggingface.co/", "main", CONFIG),
            "https://huggingface.co/depth-anything/DA3-SMALL/resolve/main/config.json"
        );
    }
}
