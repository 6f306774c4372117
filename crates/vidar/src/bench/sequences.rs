//! Finds the sequences of a downloaded and unpacked dataset.

use super::BenchKind;
use crate::error::Error;
use std::path::{Path, PathBuf};

/// A sequence to run on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// Short name, as in the paper's tables: `V1_01`, `fr1_xyz`.
    pub name: String,
    /// Its folder.
    pub path: PathBuf,
}

/// Largest depth of sequences below the root: `machine_hall/MH_01_easy/mav0`.
const DEPTH: usize = 3;

/// Every sequence of the kind below `root`, by name. Only those whose name begins with one of `prefixes`, unless that is empty.
pub fn find(root: &Path, kind: BenchKind, prefixes: &[String]) -> Result<Vec<Sequence>, Error> {
    let mut found = Vec::new();
    walk(root, kind, DEPTH, &mut found)?;
    found.sort_by(|a, b| a.name.cmp(&b.name));
    found.dedup_by(|a, b| a.name == b.name);
    if found.is_empty() {
        let expected = match kind {
            BenchKind::Euroc => "a folder with mav0/ per sequence, as EuRoC's archives unpack",
            BenchKind::Tum => "rgbd_dataset_*/ with rgb.txt, as TUM's archives unpack",
            BenchKind::TumVi => "dataset-*_512_16/ with mav0/, as TUM-VI's archives unpack",
            BenchKind::SevenScenes => "a folder per scene with seq-01/ …, as 7-Scenes' archives unpack",
        };
        let what = format!("no sequence below {}", root.display());
        return Err(Error::Usage { what, hint: format!("expected {expected}") });
    }
    let names: Vec<String> = found.iter().map(|s| s.name.clone()).collect();
    require_matches(&names, prefixes)?;
    found.retain(|s| prefixes.is_empty() || prefixes.iter().any(|w| s.name.starts_with(w.as_str())));
    Ok(found)
}

/// Refuses a prefix that no sequence has: a table without it would look complete.
pub(super) fn require_matches(names: &[String], prefixes: &[String]) -> Result<(), Error> {
    let missed = |prefix: &&String| !names.iter().any(|name| name.starts_with(prefix.as_str()));
    match prefixes.iter().find(missed) {
        None => Ok(()),
        Some(prefix) => Err(Error::Usage {
            what: format!("none of the {} sequences matches --sequences {prefix:?}", names.len()),
            hint: format!("--sequences takes prefixes of their names: {}", names.join(", ")),
        }),
    }
}

fn walk(folder: &Path, kind: BenchKind, depth: usize, found: &mut Vec<Sequence>) -> Result<(), Error> {
    let is_sequence = match kind {
        BenchKind::Euroc | BenchKind::TumVi => folder.join("mav0").is_dir(),
        BenchKind::Tum => folder.join("rgb.txt").is_file(),
        BenchKind::SevenScenes => folder.join("frame-000000.pose.txt").is_file(),
    };
    if is_sequence {
        let name_of = |f: &Path| f.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let mut name = name_of(folder);
        // Every scene has its own seq-01.
        if kind == BenchKind::SevenScenes
            && let Some(scene) = folder.parent()
        {
            name = format!("{}-{name}", name_of(scene));
        }
        found.push(Sequence { name: short(&name), path: folder.to_owned() });
        return Ok(());
    }
    if depth == 0 {
        return Ok(());
    }
    let entries = std::fs::read_dir(folder).map_err(|e| Error::io("open", folder, e))?;
    let mut folders: Vec<PathBuf> =
        entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| p.is_dir()).collect();
    folders.sort();
    folders.iter().try_for_each(|f| walk(f, kind, depth - 1, found))
}

/// `V1_01_easy` is `V1_01`, `rgbd_dataset_freiburg1_xyz` is `fr1_xyz`, `dataset-room1_512_16` is `room1`.
fn short(name: &str) -> String {
    let name = name.strip_prefix("rgbd_dataset_").unwrap_or(name).replace("freiburg", "fr");
    let name = name.strip_prefix("dataset-").map_or(name.clone(), str::to_owned);
    let ending =
        ["_easy", "_medium", "_difficult", "_512_16", "_1024_16"].iter().find_map(|e| name.strip_suffix(e));
    ending.unwrap_or(&name).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unpacked_sequences_are_found_and_named_as_in_the_paper() {
        let root = tempfile::tempdir().unwrap();
        for path in [
            "vicon_room1/V1_01_easy/mav0/cam0",
            "MH_05_difficult/mav0",
            "rgbd_dataset_freiburg1_xyz",
            "notes",
            "scenes/chess/seq-01",
            "scenes/heads/seq-01",
        ] {
            std::fs::create_dir_all(root.path().join(path)).unwrap();
        }
        std::fs::write(root.path().join("rgbd_dataset_freiburg1_xyz/rgb.txt"), "").unwrap();
        for scene in ["chess", "heads"] {
            let frame = root.path().join("scenes").join(scene).join("seq-01/frame-000000.pose.txt");
            std::fs::write(frame, "").unwrap();
        }
        let names = |kind, prefixes: &[&str]| -> Vec<String> {
            let prefixes: Vec<String> = prefixes.iter().map(|w| (*w).to_owned()).collect();
            find(root.path(), kind, &prefixes).unwrap().into_iter().map(|s| s.name).collect()
        };
        assert_eq!(names(BenchKind::Euroc, &[]), ["MH_05", "V1_01"]);
        assert_eq!(names(BenchKind::Euroc, &["V1"]), ["V1_01"]);
        assert_eq!(names(BenchKind::Tum, &[]), ["fr1_xyz"]);
        assert_eq!(names(BenchKind::SevenScenes, &[]), ["chess-seq-01", "heads-seq-01"]);
        let vi = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(vi.path().join("dataset-room1_512_16/mav0")).unwrap();
        assert_eq!(find(vi.path(), BenchKind::TumVi, &[]).unwrap()[0].name, "room1");
        let error = find(root.path(), BenchKind::Euroc, &["V9".into()]).unwrap_err();
        assert!(error.to_string().contains("none of the 2 sequences"), "{error}");
    }
}
