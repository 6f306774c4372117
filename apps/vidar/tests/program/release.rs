//! `tools/release.sh` packs a program that runs away from the checkout, with what its licences ask for.

use crate::support::VIDAR;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn repository() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

fn release(arguments: &[&str]) -> Output {
    Command::new("bash").arg(repository().join("tools/release.sh")).args(arguments).output().unwrap()
}

fn is_available() -> bool {
    let is_there = cfg!(unix) && Command::new("tar").arg("--version").output().is_ok();
    if !is_there {
        vidar_core::testing::skipped(&"tools/release.sh needs bash and tar");
    }
    is_there
}

fn run(program: &Path, arguments: &[&str]) -> String {
    let output = Command::new(program).current_dir("/").args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn the_packed_program_runs_and_has_its_licences_and_completions() {
    if !is_available() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("files");
    let output = release(&["--binary", VIDAR, "--no-wheel", "--out", out.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    let mut files: Vec<PathBuf> =
        std::fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let [sums, archive] = files.as_slice() else { panic!("{files:?}") };
    let name = archive.file_name().unwrap().to_str().unwrap();
    let stem = name.strip_suffix(".tar.gz").unwrap();
    assert!(stem.starts_with(concat!("vidar-", env!("CARGO_PKG_VERSION"), "-")), "{stem}");
    let sum = vidar::hub::sha256_hex(&std::fs::read(archive).unwrap());
    assert_eq!(std::fs::read_to_string(sums).unwrap(), format!("{sum}  {name}\n"));

    let user = folder.path().join("user");
    std::fs::create_dir(&user).unwrap();
    let unpacked = Command::new("tar").arg("xzf").arg(archive).arg("-C").arg(&user).status().unwrap();
    assert!(unpacked.success());
    let program = user.join(stem).join("vidar");
    assert!(run(&program, &["--version"]).starts_with(concat!("vidar ", env!("CARGO_PKG_VERSION"))));
    assert!(run(&program, &["doctor"]).contains("da3-nano: built in"));
    assert!(program.metadata().unwrap().len() <= Path::new(VIDAR).metadata().unwrap().len(), "stripped");

    let text = |name: &str| std::fs::read_to_string(user.join(stem).join(name)).unwrap();
    for (file, has) in [
        ("LICENSE-MIT", "Permission is hereby granted"),
        ("LICENSE-APACHE", "TERMS AND CONDITIONS"),
        ("NOTICE", "ColorBrewer"),
        ("THIRD-PARTY-LICENSES.txt", "\nclap 4"),
        ("WEIGHTS.md", "da3-nano"),
        ("README.md", "vidar run"),
        ("CHANGELOG.md", "# Changelog"),
        ("completions/vidar.bash", "odometry"),
        ("completions/vidar.zsh", "odometry"),
        ("completions/vidar.fish", "odometry"),
    ] {
        assert!(text(file).contains(has), "{file} lacks {has:?}");
    }
}

#[test]
fn a_program_of_another_version_is_not_packed() {
    if !is_available() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let other = folder.path().join("vidar");
    std::fs::write(&other, "#!/bin/sh\necho vidar 0.0.1\n").unwrap();
    #[cfg(unix)]
    std::fs::set_permissions(&other, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    let out = folder.path().join("files");
    let output =
        release(&["--binary", other.to_str().unwrap(), "--no-wheel", "--out", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2));
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains("says \"vidar 0.0.1\""), "{told}");
    assert!(!out.exists(), "what failed is not left behind");
    assert_eq!(release(&["--verbose"]).status.code(), Some(2), "an unknown argument");
}
