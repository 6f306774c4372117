//! The files of one recording that recorders split it into.

use crate::error::BagError;
use std::path::{Path, PathBuf};

/// Most files of one recording.
pub(crate) const MAX_FILES: usize = 10_000;

/// The bags in a folder, where they are the numbered parts of one recording or only one. ROS 2 numbers one name (`x_0.mcap`, `x_1.mcap`), ROS 1
/// writes the time at which each part began before the number (`x_2024-05-01-10-00-00_0.bag`).
pub(crate) fn parts_in(folder: &Path) -> Result<Vec<PathBuf>, BagError> {
    let mut parts = bags_in(folder)?;
    let not_one = |found: String| BagError::NotABag {
        path: folder.to_path_buf(),
        found,
        expected: "one bag, the numbered parts of one (x_0.bag, x_1.bag), or a metadata.yaml; name a file"
            .into(),
    };
    parts.sort_by_key(|path| number_of(path).map(|(_, number)| number));
    match parts.as_slice() {
        [] => Err(not_one("a folder without bags".into())),
        [_] => Ok(parts),
        all if are_one(all) => Ok(parts),
        all => {
            let names =
                all.iter().take(6).map(|p| p.file_name().unwrap_or_default().to_string_lossy().into_owned());
            Err(not_one(format!("{} bags: {}", all.len(), names.collect::<Vec<_>>().join(", "))))
        }
    }
}

/// Whether files, sorted by their numbers, have one name and numbers without gap or repetition.
fn are_one(parts: &[PathBuf]) -> bool {
    let follows = |pair: &[PathBuf]| match (number_of(&pair[0]), number_of(&pair[1])) {
        (Some((name, number)), Some((next_name, next))) => {
            name == next_name
                && Some(next) == number.checked_add(1)
                && pair[0].extension() == pair[1].extension()
        }
        _ => false,
    };
    parts.windows(2).all(follows)
}

/// The name of a part without its time, and its number.
fn number_of(path: &Path) -> Option<(String, u64)> {
    let stem = path.file_stem()?.to_string_lossy().into_owned();
    let (name, number) = stem.rsplit_once('_')?;
    let name = match name.rsplit_once('_') {
        Some((before, time)) if is_time(time) => before,
        _ if is_time(name) => "",
        _ => name,
    };
    Some((name.to_string(), number.parse().ok()?))
}

/// `2024-05-01-10-00-00`.
fn is_time(text: &str) -> bool {
    let mut fields = text.split('-');
    let is_number =
        |field: &str, digits: usize| field.len() == digits && field.bytes().all(|b| b.is_ascii_digit());
    fields.next().is_some_and(|year| is_number(year, 4))
        && fields.clone().count() == 5
        && fields.all(|field| is_number(field, 2))
}

/// Files in a folder that are named as bags.
pub fn bags_in(folder: &Path) -> Result<Vec<PathBuf>, BagError> {
    let failed = |source| BagError::Io { path: folder.to_path_buf(), source };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        if matches!(ending.as_deref(), Some("bag" | "mcap" | "db3"))
            && path.is_file()
            && found.len() < MAX_FILES
        {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(names: &[&str]) -> Result<Vec<String>, String> {
        let folder = tempfile::tempdir().unwrap();
        names.iter().for_each(|name| std::fs::write(folder.path().join(name), b"").unwrap());
        let parts = parts_in(folder.path()).map_err(|e| e.to_string())?;
        Ok(parts.iter().map(|p| p.file_name().unwrap().to_string_lossy().into_owned()).collect())
    }

    #[test]
    fn parts_are_taken_in_the_order_of_their_numbers_whatever_stands_before() {
        let ros2 = ["x_9.mcap", "x_10.mcap", "x_11.mcap"];
        assert_eq!(found(&ros2).unwrap(), ros2);
        let ros1 = ["d_2024-05-01-10-00-05_0.bag", "d_2024-05-01-10-05-05_1.bag"];
        assert_eq!(found(&ros1).unwrap(), ros1);
        let unnamed = ["2024-05-01-23-59-00_0.bag", "2024-05-02-00-04-00_1.bag"];
        assert_eq!(found(&unnamed).unwrap(), unnamed);
        assert_eq!(found(&["only.bag"]).unwrap(), ["only.bag"]);
    }

    #[test]
    fn several_recordings_are_not_one() {
        // Two recordings of one name, a part that is missing, two names, two containers.
        for names in [
            &["d_2024-05-01-10-00-05_0.bag", "d_2024-05-02-10-05-05_0.bag"][..],
            &["x_0.bag", "x_2.bag"],
            &["x_0.bag", "y_1.bag"],
            &["x_0.bag", "x_1.mcap"],
            &["one.bag", "two.bag"],
        ] {
            let error = found(names).unwrap_err();
            assert!(error.contains(names[0]) && error.contains("name a file"), "{error}");
        }
        assert!(found(&[]).unwrap_err().contains("without bags"));
    }
}
