//! `vidar compare`, and the three-dimensional view of the report, as files; `crates/vidar-view/tests/browser` looks at the view.

use crate::support::{copy_tree, finished, keys, run_on, shared, vidar};
use serde_json::Value;
use std::path::Path;

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// What a page gives to its view.
fn data_of(page: &Path) -> Value {
    let html = std::fs::read_to_string(page).unwrap();
    assert_eq!(html.matches("</script>").count(), 2, "data and program");
    for foreign in ["http://", "https://", "@import", "<link"] {
        assert!(!html.contains(foreign), "{foreign}");
    }
    let json = html.split("id=\"view-data\">").nth(1).unwrap().split("</script>").next().unwrap();
    serde_json::from_str(json).unwrap()
}

fn field<'a>(pane: &'a Value, id: &str) -> &'a Value {
    pane["fields"].as_array().unwrap().iter().find(|f| f["id"] == id).unwrap()
}

#[test]
fn runs_are_compared_on_one_page_and_a_run_equals_itself() {
    let folder = tempfile::tempdir().unwrap();
    let (again, coarse, page) =
        (folder.path().join("again <b>"), folder.path().join("coarse"), folder.path().join("new/page.html"));
    copy_tree(&finished().0, &again);
    run_on(
        &shared().sequence,
        &coarse,
        &["-q", "--set", "eval.mode=auto", "--set", "fusion.voxel_size_m=0.08"],
    )
    .ends_with(0);
    let runs = [text(&finished().0), text(&again), text(&coarse)];
    let args = [&["compare"], &runs[..], &["-o", text(&page), "--json"]].concat();
    let json = vidar(&args).ends_with(0).json();
    assert_eq!(json["schema"], "vidar.compare/1");
    assert_eq!(keys(&json, 1), ["schema", "page", "bytes", "runs", "settings"]);
    let one = &json["runs"][1];
    assert_eq!(
        keys(one, 1),
        ["name", "folder", "is_metric", "scale_sigma", "verdict", "scores", "placement", "distance"]
    );
    // The same run is where it is, and as near to itself as points of a surface are to each other.
    assert!(one["placement"]["rms_m"].as_f64().unwrap() < 1e-9, "{one}");
    assert!(one["distance"]["to_first"]["median_m"].as_f64().unwrap() < 1e-6, "{one}");
    let other = json["runs"][2]["distance"]["to_first"]["median_m"].as_f64().unwrap();
    assert!((1e-4..0.08).contains(&other), "{other}");
    assert_eq!(json["settings"]["fusion.voxel_size_m"][2], 0.08);

    assert_eq!(std::fs::metadata(&page).unwrap().len(), json["bytes"].as_u64().unwrap());
    let data = data_of(&page);
    let panes = data["panes"].as_array().unwrap();
    assert_eq!(
        panes.iter().map(|p| p["name"].as_str().unwrap()).collect::<Vec<_>>(),
        ["finished run", "again <b>", "coarse"]
    );
    assert_eq!((&data["shown"], &data["coloring"]), (&"all".into(), &"difference".into()));
    for pane in panes {
        let at = pane["fields"].as_array().unwrap().iter().position(|f| f["id"] == "difference").unwrap();
        assert!(pane["mesh"]["values"][at].is_string(), "{} has no distances", pane["name"]);
    }
    assert!(!std::fs::read_to_string(&page).unwrap().contains("again <b>"), "a name is markup");

    // A page in the way stays, unless told otherwise, and then has the same bytes.
    let before = std::fs::read(&page).unwrap();
    vidar(&args).ends_with(2).says(&["exists", "--force"]);
    let ran = vidar(&[&["compare"], &runs[..], &["-o", text(&page), "--force", "--threads", "1"]].concat());
    assert!(ran.ends_with(0).stdout.contains("look at it"));
    assert_eq!(std::fs::read(&page).unwrap(), before);
}

#[test]
fn what_cannot_be_compared_is_refused() {
    let run = text(&finished().0);
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("page.html");
    let none = folder.path().join("none");
    vidar(&["compare", run, "-o", text(&page)]).ends_with(2).says(&["1 runs", "hint:"]);
    vidar(&["compare", run, run, run, run, run, "-o", text(&page)]).ends_with(2).says(&["5 runs", "2 to 4"]);
    vidar(&["compare", run, text(&none), "-o", text(&page)]).ends_with(1).says(&["error[E0207]", "none"]);
    assert!(!page.exists());
}

#[test]
fn the_report_of_a_run_holds_its_map_in_three_dimensions() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let more = ["-q", "--set", "eval.mode=auto", "--set", "output.report=true"];
    run_on(&shared().sequence, &out, &more).ends_with(0);
    let page = out.join("report.html");
    let data = data_of(&page);
    let panes = data["panes"].as_array().unwrap();
    assert_eq!(panes.iter().map(|p| p["name"].as_str().unwrap()).collect::<Vec<_>>(), ["map", "reference"]);
    let map = &panes[0];
    assert!(
        map["mesh"]["triangles"].as_u64().unwrap() > 1000
            && map["cloud"]["vertices"].as_u64().unwrap() > 1000
    );
    assert!(map["isMetric"] == true && map["scaleLogStd"].is_number(), "{}", map["scaleLogStd"]);
    assert!(field(map, "error")["reason"].is_null() && field(map, "confidence")["reason"].is_null());
    assert!(field(map, "sigma")["reason"].is_null(), "auto states it");
    let keyframes = map["keyframes"].as_array().unwrap();
    assert!(
        keyframes.len() > 3 && keyframes.iter().all(|k| k["image"].is_string() && k["depth"].is_string())
    );
    assert!(std::fs::metadata(&page).unwrap().len() < 8_000_000);
    assert!(panes[1]["cloud"]["normals"].is_string(), "points of the reference have no sides");
}
