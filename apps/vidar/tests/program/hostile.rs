//! Input that means harm: names that terminals obey, files without an end, archives of zeros, hubs with other weights.

use crate::support::{command, copy_tree, files_under, http_server, shared, vidar};
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[cfg(unix)]
#[test]
fn control_characters_in_names_reach_neither_terminal_nor_files() {
    let evil = "evil\u{1b}[2J\u{9b}1m\u{202e}\nname";
    let sequence = shared().root.join(evil);
    copy_tree(&shared().sequence, &sequence);
    let trajectory = shared().root.join(format!("{evil}.tum"));
    let truth = sequence.join("mav0/state_groundtruth_estimate0/data.csv");
    std::fs::copy(truth, &trajectory).unwrap();
    std::fs::write(sequence.join("mav0/cam0/data/extra\u{1b}]0;x.png"), b"").unwrap();
    let out = shared().root.join("evil run");
    let mut run = command();
    run.arg("run").arg(&sequence).arg("-o").arg(&out).arg("--config").arg(&shared().settings);
    run.args([
        "--stride",
        "2",
        "--set",
        "input.poses=external",
        "--set",
        "output.report=true",
        "--trajectory",
    ]);
    let ran: crate::support::ProgramOutput = run.arg(&trajectory).output().unwrap().into();
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let inspected = vidar(&["inspect", text(&sequence)]);
    let refused = vidar(&["run", &format!("/no/such {evil}")]);
    let is_obeyed = |c: char| (c.is_control() && !"\n\t".contains(c)) || c == '\u{202e}';
    for shown in [&ran.stdout, &ran.stderr, &inspected.stdout, &inspected.stderr, &refused.stderr] {
        assert!(!shown.contains(is_obeyed), "{shown:?}");
        assert!(!shown.lines().any(|l| l.starts_with("name")), "a name began a line: {shown}");
    }
    assert!(refused.stderr.contains(r"\u{1b}[2J"), "{}", refused.stderr);
    for name in files_under(&out).iter().filter(|n| !n.ends_with(".png") && !n.ends_with(".glb")) {
        let bytes = std::fs::read(out.join(name)).unwrap();
        // Binary parts of PLY are no text.
        let text = String::from_utf8_lossy(
            &bytes[..bytes.len().min(if name.ends_with(".ply") { 600 } else { usize::MAX })],
        );
        let text = text.split("end_header").next().unwrap();
        assert!(!text.contains(is_obeyed), "{name} holds control characters");
    }
}

#[cfg(unix)]
#[test]
fn files_without_an_end_are_refused_at_once_and_in_little_memory() {
    let sequence = text(&shared().sequence).to_owned();
    let zero = "/dev/zero";
    for args in [
        vec!["config", "show", "--config", zero],
        vec!["synth", "never made", "--world-config", zero],
        vec!["inspect", &sequence, "--trajectory", zero],
        vec!["inspect", &sequence, "--calibration", zero],
        vec!["inspect", &sequence, "--timestamps", zero],
        vec!["eval", zero, zero],
    ] {
        let clock = Instant::now();
        // A bound on memory that two gigabytes would break.
        let mut limited = std::process::Command::new("sh");
        limited.arg("-c").arg("ulimit -v 1500000; exec \"$0\" \"$@\"").arg(crate::support::VIDAR).args(&args);
        let ran: crate::support::ProgramOutput = limited.current_dir(&shared().root).output().unwrap().into();
        assert!(
            [0, 1, 2].contains(&ran.code) && !ran.stderr.contains("panicked"),
            "{args:?}: {} {}",
            ran.code,
            ran.stderr
        );
        assert!(ran.code != 0 || args.contains(&"--timestamps"), "{args:?}: {}", ran.stdout);
        assert!(clock.elapsed() < Duration::from_secs(20), "{args:?} took {:?}", clock.elapsed());
    }
}

#[test]
fn weights_that_are_not_the_official_ones_are_refused_by_their_hash() {
    // A hub that announces another file of the right length under the official name.
    let address = http_server(|first| {
        let etag = "0".repeat(64);
        let body = if first.contains("config.json") { "{}" } else { "" };
        let head = format!(
            "HTTP/1.1 200 OK\r\nConnection: close\r\nX-Linked-ETag: \"{etag}\"\r\nContent-Length: {}\r\n\r\n",
            body.len()
        );
        if first.starts_with("GET") { head + body } else { head }
    });
    let models = tempfile::tempdir().unwrap();
    let mut pull = command();
    pull.args(["model", "pull", "da3-small"]).env("HF_ENDPOINT", &address).env("VIDAR_MODELS", models.path());
    pull.env("NO_PROXY", "127.0.0.1").env("no_proxy", "127.0.0.1").stdin(Stdio::null());
    let ran: crate::support::ProgramOutput = pull.output().unwrap().into();
    let announced = format!("has SHA-256 {}, expected a486e29e", "0".repeat(64));
    ran.ends_with(4).says(&["error[E0405]", &announced, "not the official one"]);
    assert!(
        !files_under(models.path()).iter().any(|f| f.ends_with("model.safetensors")),
        "{:?}",
        files_under(models.path())
    );
}

/// Lists of ten million rows: of the IMU, of images, of ground truth.
#[cfg(target_os = "linux")]
#[test]
fn ten_million_rows_take_less_than_300_megabytes() {
    use std::io::Write;
    const ROWS: i64 = 10_000_000;
    const MOST_BYTES: u64 = 300_000_000;
    let sequence = shared().root.join("ten million rows");
    copy_tree(&shared().sequence, &sequence);
    const LISTS: [(&str, &str, &str); 3] = [
        ("imu0", ",0.1,0.2,0.3,0.1,0.2,9.8", "split the recording"),
        ("cam0", "", "split the recording"),
        ("state_groundtruth_estimate0", ",0,0,0,1,0,0,0,0,0,0,0,0,0,0,0,0", "the limit for such a file"),
    ];
    for (list, columns, said) in LISTS {
        let path = sequence.join("mav0").join(list).join("data.csv");
        let usual = std::fs::read(&path).unwrap();
        let mut file = std::io::BufWriter::new(std::fs::File::create(&path).unwrap());
        for i in 0..ROWS {
            writeln!(file, "{}{columns}", 5_000_000 * i).unwrap();
        }
        drop(file);
        let mut inspect = command();
        inspect.arg("inspect").arg(&sequence).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = inspect.spawn().unwrap();
        // The most that was resident, as long as the process can be asked.
        let (mut peak, status) = (0, format!("/proc/{}/status", child.id()));
        while child.try_wait().unwrap().is_none() {
            let text = std::fs::read_to_string(&status).unwrap_or_default();
            // Before the program is executed the numbers are those of this process.
            let is_program = text.starts_with("Name:\tvidar\n");
            let line = text.lines().find_map(|l| l.strip_prefix("VmHWM:")).filter(|_| is_program);
            let kib = line.and_then(|l| l.trim().trim_end_matches(" kB").parse::<u64>().ok());
            peak = peak.max(kib.unwrap_or(0) * 1024);
            std::thread::sleep(Duration::from_millis(5));
        }
        let ran: crate::support::ProgramOutput = child.wait_with_output().unwrap().into();
        ran.ends_with(1).says(&["data.csv", said]);
        assert!(peak < MOST_BYTES, "{list}: {} MB", peak / 1_000_000);
        // A file that is refused by its size ends the program before it can be asked.
        let is_read = said == "split the recording";
        assert!(!is_read || peak > 1_000_000, "{list}: nothing was measured");
        std::fs::write(&path, usual).unwrap();
    }
}
