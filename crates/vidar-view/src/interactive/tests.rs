use super::payload::{index_bytes, safe_in_script};
use super::*;
use crate::{Report, render_html};
use serde_json::Value;
use vidar_core::{BodyFrame, CameraId, StampedPose, Timestamp};

/// A wavy floor of n × n quads, 4 m wide.
fn floor(n: usize) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for i in 0..=n {
        for j in 0..=n {
            let (x, y) = (4.0 * i as f32 / n as f32, 4.0 * j as f32 / n as f32);
            mesh.positions.push([x, y, 0.05 * (3.0 * x).sin()]);
            mesh.colors.push([(i % 256) as u8, (j % 256) as u8, 90]);
            mesh.confidences.push(i as f32 / n as f32);
        }
    }
    for i in 0..n {
        for j in 0..n {
            let at = |i: usize, j: usize| (i * (n + 1) + j) as u32;
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

fn flight() -> Trajectory {
    let pose = |i: i64| StampedPose {
        time: Timestamp::from_nanos(1_600_000_000_000_000_000 + i * 100_000_000),
        world_from_body: Se3::from_translation(Vector3::new(2.0 + 0.1 * i as f64, 2.0, 1.5)),
    };
    Trajectory::new(BodyFrame::Camera(CameraId(0)), (0..10).map(pose).collect()).unwrap()
}

fn pane<'a>(name: &str, mesh: &'a TriangleMesh, path: &'a Trajectory, fields: Vec<Field<'a>>) -> Pane<'a> {
    Pane {
        name: name.to_owned(),
        mesh: Some(mesh),
        cloud: None,
        fields,
        paths: vec![PanePath { name: "trajectory".into(), role: PathRole::Estimate, trajectory: path }],
        keyframes: Vec::new(),
        scale: PaneScale::Metric { log_std: Some(0.01) },
    }
}

fn view(panes: Vec<Pane<'_>>) -> InteractiveView<'_> {
    InteractiveView { panes, up: Vector3::z(), shown: PanesShown::First, coloring: None }
}

fn page(view: &InteractiveView<'_>) -> String {
    render_html(&Report { view: Some(encode_view(view).unwrap()), ..Report::default() })
}

/// The JSON of a page, as a browser reads it.
fn data(html: &str) -> Value {
    let start = html.split("id=\"view-data\">").nth(1).unwrap();
    serde_json::from_str(start.split("</script>").next().unwrap()).unwrap()
}

#[test]
fn a_page_holds_all_that_it_needs_and_every_name_is_harmless() {
    let (mesh, path) = (floor(4), flight());
    let evil = "</script><script>alert(1)</script>\u{2028}<!--";
    let missing = Field {
        kind: FieldKind::Error,
        label: evil.into(),
        values: FieldValues::Missing(format!("\"{evil}")),
    };
    let html =
        page(&view(vec![pane(evil, &mesh, &path, vec![missing]), pane("b", &mesh, &path, Vec::new())]));
    assert_eq!(html.matches("<script").count(), 2, "data and program");
    assert_eq!(html.matches("</script>").count(), 2);
    assert!(!html.contains("alert(1)</script>") && !html.contains('\u{2028}') && !html.contains("<!--"));
    for foreign in
        ["http://", "https://", "//cdn", "@import", "url(", "<link", "<iframe", "import(", "fetch("]
    {
        assert!(!html.contains(foreign), "{foreign}");
    }
    assert!(html.contains("default-src 'none'"));
    let reason = data(&html)["panes"][0]["fields"][0]["reason"].as_str().unwrap().to_owned();
    assert!(reason.contains("</script>"), "{reason}");
    // What is not available is in the list with its reason, and cannot be chosen.
    assert!(html.contains(
        "<option value=\"error\" disabled>error: distance to the reference (not available: &quot;"
    ));
}

#[test]
fn a_report_without_a_view_has_no_script() {
    assert!(!render_html(&Report::default()).contains("<script"));
}

#[test]
fn labels_and_roles_are_there_for_readers_that_do_not_see() {
    let (mesh, path) = (floor(4), flight());
    let html = page(&view(vec![pane("map", &mesh, &path, Vec::new())]));
    for part in [
        "aria-live=\"polite\"",
        "role=\"application\"",
        "aria-label=\"The map in three dimensions\"",
        "<noscript>",
    ] {
        assert!(html.contains(part), "{part}");
    }
    // Every input lies in its label, or has one.
    let inputs = html.matches("<input ").count();
    let labels = html.matches("<label").count();
    assert!(inputs > 5 && labels >= inputs, "{labels} labels of {inputs} inputs");
}

#[test]
fn indices_are_read_back_from_their_bytes() {
    let triangles = [[0, 1, 2], [2, 1, 3], [3, 1, 4], [0, 4, 5], [300, 0, 5]];
    // The last one skips numbers, which the encoder never does; what is read is then another mesh, not a crash.
    let bytes = index_bytes(&triangles[..4]);
    let (mut at, mut next, mut read) = (0, 0_u32, Vec::new());
    while at < bytes.len() {
        let (mut code, mut shift) = (0_u32, 0);
        while bytes[at] >= 128 {
            code |= u32::from(bytes[at] & 127) << shift;
            shift += 7;
            at += 1;
        }
        code |= u32::from(bytes[at]) << shift;
        at += 1;
        read.push(next - code);
        next += u32::from(code == 0);
    }
    assert_eq!(read, triangles[..4].concat());
}

#[test]
fn positions_are_right_to_a_step_of_their_box() {
    let (mesh, path) = (floor(30), flight());
    let html = page(&view(vec![pane("map", &mesh, &path, Vec::new())]));
    let data = data(&html);
    let packed = &data["panes"][0]["mesh"];
    use base64::Engine;
    let steps = base64::engine::general_purpose::STANDARD
        .decode(packed["positions"]["steps"].as_str().unwrap())
        .unwrap();
    assert_eq!(packed["vertices"].as_u64().unwrap() as usize, mesh.positions.len());
    let number = |name: &str, axis: usize| packed["positions"][name][axis].as_f64().unwrap();
    let place = |v: usize, axis: usize| {
        let at = 6 * v + 2 * axis;
        number("lower", axis)
            + number("step", axis) * f64::from(u16::from_le_bytes([steps[at], steps[at + 1]]))
    };
    // Vertices come in the order of use: those of the first triangle first.
    for (v, &i) in mesh.triangles[0].iter().enumerate() {
        for axis in 0..3 {
            let error = place(v, axis) - f64::from(mesh.positions[i as usize][axis]);
            assert!(error.abs() <= 0.51 * number("step", axis), "{error}");
        }
    }
    assert!(number("step", 0) < 1e-4);
}

#[test]
fn a_large_map_fits_its_share_of_a_page_and_the_same_map_gives_the_same_bytes() {
    let (mesh, path) = (floor(500), flight());
    let cloud = PointCloud {
        positions: mesh.positions.clone(),
        colors: mesh.colors.clone(),
        ..PointCloud::default()
    };
    let own = || Field { kind: FieldKind::Confidence, label: "confidence".into(), values: FieldValues::Own };
    let errors: Vec<f32> = mesh.positions.iter().map(|p| p[0] * 0.01).collect();
    let sampled = || Field {
        kind: FieldKind::Error,
        label: "error [m]".into(),
        values: FieldValues::Samples { positions: &mesh.positions, values: &errors, range: (0.0, 0.1) },
    };
    let encode = |threads: usize| {
        let pane = Pane { cloud: Some(&cloud), ..pane("map", &mesh, &path, vec![own(), sampled()]) };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| encode_view(&view(vec![pane])).unwrap())
    };
    let encoded = encode(1);
    assert!((130_000..=MAX_TRIANGLES).contains(&encoded.triangles()), "{}", encoded.triangles());
    assert!((70_000..=MAX_POINTS).contains(&encoded.points()), "{}", encoded.points());
    // With 3 MB of pictures a report stays below 8 MB.
    assert!(encoded.size_bytes() < 5_000_000, "{}", encoded.size_bytes());
    assert_eq!(encoded, encode(4));
}

#[test]
fn inconsistent_surfaces_and_values_are_refused() {
    let (mut mesh, path) = (floor(2), flight());
    mesh.colors.pop();
    assert!(matches!(
        encode_view(&view(vec![pane("map", &mesh, &path, Vec::new())])),
        Err(ViewError::InconsistentSurface { .. })
    ));
    let mesh = floor(2);
    let samples = FieldValues::Samples { positions: &mesh.positions, values: &[0.0], range: (0.0, 1.0) };
    let field = Field { kind: FieldKind::Error, label: String::new(), values: samples };
    assert!(matches!(
        encode_view(&view(vec![pane("map", &mesh, &path, vec![field])])),
        Err(ViewError::WrongValueCount { .. })
    ));
}

#[test]
fn nothing_at_all_is_still_a_page() {
    let html = page(&view(Vec::new()));
    assert!(data(&html)["panes"].as_array().unwrap().is_empty());
    assert_eq!(safe_in_script("a</b>&\u{2029}"), "a\\u003c/b\\u003e\\u0026\\u2029");
}
