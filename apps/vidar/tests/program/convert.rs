//! `vidar convert`: the program writes what it reads.

use crate::support::{shared, vidar};

fn text(path: &std::path::Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_recording_becomes_mcap_and_an_euroc_folder_again() {
    let folder = tempfile::tempdir().unwrap();
    let (bag, again) = (folder.path().join("out.mcap"), folder.path().join("again"));
    let sequence = text(&shared().sequence);
    let first = vidar(&["convert", sequence, text(&bag), "--json"]).ends_with(0).json();
    assert_eq!((first["schema"].as_str(), first["format"].as_str()), (Some("vidar.convert/1"), Some("mcap")));
    let second = vidar(&["convert", text(&bag), text(&again), "--json"]).ends_with(0).json();
    for count in ["images", "imu_samples", "depths", "truth_poses"] {
        assert_eq!(first[count], second[count], "{count}");
    }
    assert!(first["images"].as_u64().unwrap() >= 10 && first["imu_samples"].as_u64().unwrap() > 100);
    let inspected = vidar(&["inspect", text(&again), "--json"]).ends_with(0).json();
    assert_eq!(inspected["kind"].as_str(), Some("euroc"));
    // A part of it, in words.
    let part = folder.path().join("part.mcap");
    let ran = vidar(&["convert", sequence, text(&part), "--end", "1"]).ends_with(0);
    assert!(ran.stdout.contains("(euroc as mcap)") && ran.stdout.contains("images"), "{}", ran.stdout);
    assert!(part.metadata().unwrap().len() < bag.metadata().unwrap().len());
}

#[test]
fn convert_overwrites_nothing_and_names_its_layouts() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out.mcap");
    std::fs::write(&out, "mine").unwrap();
    let sequence = text(&shared().sequence);
    vidar(&["convert", sequence, text(&out)]).ends_with(2).says(&["exists", "nothing is overwritten"]);
    assert_eq!(std::fs::read(&out).unwrap(), b"mine");
    let new = folder.path().join("new");
    vidar(&["convert", sequence, text(&new), "--to", "avi"]).says(&["mcap or euroc"]);
    vidar(&["convert", text(&folder.path().join("none")), text(&new)]).ends_with(1);
    assert!(!new.exists());
}
