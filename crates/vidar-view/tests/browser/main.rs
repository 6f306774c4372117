//! The three-dimensional view in a real browser, with a mouse and a keyboard: it draws, turns, measures and shows keyframes.
// Tests stop at the first surprise and say loudly what they skip.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stderr)]

mod chromium;
mod room;

use chromium::{Page, browser};
use serde_json::Value;
use std::path::PathBuf;

const WINDOW: (u32, u32) = (1100, 1000);
/// Shift, as the protocol numbers it.
const SHIFT: u32 = 8;

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("no number: {value}"))
}

fn written(folder: &tempfile::TempDir, is_metric: bool) -> PathBuf {
    let path = folder.path().join("room.html");
    std::fs::write(&path, room::page(is_metric)).unwrap();
    path
}

/// The place on the page of a point of the world.
fn place_of(page: &mut Page, point: [f64; 3]) -> (f64, f64) {
    page.value(
        "document.getElementById('view-canvas').scrollIntoView({block: 'center', behavior: 'instant'})",
    );
    let at = page.value(&format!(
        "(() => {{ const p = vidarView.project({point:?}); const b = document.getElementById('view-canvas').getBoundingClientRect();
        return [p.x + b.left, p.y + b.top]; }})()"
    ));
    (number(&at[0]), number(&at[1]))
}

#[test]
fn it_draws_turns_and_changes_colours() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut page = Page::open(&browser, &written(&folder, true), "", WINDOW);
    let first = page.value("vidarView.pixels()");
    assert!(number(&first["share"]) > 0.2, "the picture is blank: {first}");
    let state = page.value("vidarView.state()");
    assert_eq!(number(&state["triangles"]) as usize, room::mesh().triangles.len());

    // A drag turns the map; the picture changes.
    let middle = place_of(&mut page, room::MIDDLE);
    page.drag(middle, (middle.0 + 150.0, middle.1 + 40.0));
    let turned = page.value("vidarView.pixels()");
    assert_ne!(first["hash"], turned["hash"], "a drag changed nothing");
    assert_ne!(state["forward"], page.value("vidarView.state()")["forward"]);

    // Keys turn it, too, and Home shows the whole map again, as at first.
    page.key("ArrowLeft");
    assert_ne!(page.value("vidarView.pixels()")["hash"], turned["hash"], "a key changed nothing");
    page.key("Home");
    assert_eq!(page.value("vidarView.pixels()"), first);

    // Every colouring that is offered gives another picture.
    let mut seen = vec![first["hash"].clone()];
    for coloring in ["height", "confidence", "error", "sigma"] {
        page.value(&format!(
            "{{ const s = document.getElementById('view-coloring'); s.value = '{coloring}'; s.dispatchEvent(new Event('change')); }}"
        ));
        let hash = page.value("vidarView.pixels()")["hash"].clone();
        assert!(!seen.contains(&hash), "{coloring} looks like another colouring");
        seen.push(hash);
    }

    // The reference stands beside it.
    page.value("document.getElementById('view-pane-1').click()");
    let both = page.value("vidarView.pixels()");
    assert!(!seen.contains(&both["hash"]) && number(&both["share"]) > 0.1, "{both}");
    assert_eq!(page.value("vidarView.state().shown"), serde_json::json!([true, true]));
    assert_eq!(page.errors, Vec::<String>::new());
    assert!(
        page.requests.iter().all(|r| r.starts_with("file:") || r.starts_with("data:")),
        "{:?}",
        page.requests
    );
}

#[test]
fn it_measures_known_distances() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut page = Page::open(&browser, &written(&folder, true), "", WINDOW);
    // Two vertices of the floor, seen from above.
    let (a, b) = ([1.0, 1.0, 0.0], [3.0, 2.0, 0.0]);
    let distance = 5f64.sqrt();
    page.value("vidarView.look([2.0, 1.4, 2.2], [2.0, 1.5, 0.0])");
    page.value("document.getElementById('view-measure').click()");

    // With Shift the nearest vertex is taken: right to the quantisation of positions.
    for point in [a, b] {
        let at = place_of(&mut page, point);
        page.click((at.0 + 1.0, at.1 - 1.0), SHIFT);
    }
    let steps = page.value("vidarView.state().step");
    let step = (0..3).map(|i| number(&steps[i])).fold(0.0, f64::max);
    let found = page.value("vidarView.measurement()");
    assert!(step < 1e-4 && (number(&found["value"]) - distance).abs() < 2.0 * step, "{found}, step {step}");
    // The scale is known to 1.2 %, and so is every length.
    let text = found["text"].as_str().unwrap();
    assert!(text.contains("2.236 m ± 0.027 m") && text.contains("1.2 %"), "{text}");
    assert_eq!(
        page.value("document.getElementById('view-status').textContent"),
        format!("Distance: {text}.")
    );

    // Without it the surface itself: right to a pixel, and on the floor to a step.
    for point in [a, b] {
        let at = place_of(&mut page, point);
        page.click(at, 0);
    }
    let found = page.value("vidarView.measurement()");
    let pixel = number(&page.value("vidarView.pixelLength(2.6)"));
    assert!((number(&found["value"]) - distance).abs() < 2.0 * pixel, "{found}, a pixel is {pixel}");
    for i in 0..2 {
        assert!(number(&found["points"][i][2]).abs() < 2.0 * step, "{found}");
    }

    // The keyboard measures, too: the cross is in the middle.
    page.key("Escape");
    page.value("document.getElementById('view-canvas').focus()");
    page.key("m");
    for aim in [a, b] {
        page.value(&format!("vidarView.look([2.0, 1.4, 2.0], {aim:?})"));
        page.key("Enter");
    }
    let found = page.value("vidarView.measurement()");
    assert!((number(&found["value"]) - distance).abs() < 1e-3, "{found}");
    assert_eq!(page.errors, Vec::<String>::new());
}

#[test]
fn lengths_of_a_run_that_is_not_metric_are_said_not_to_be() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut page = Page::open(&browser, &written(&folder, false), "", WINDOW);
    page.value("vidarView.look([2.0, 1.4, 2.2], [2.0, 1.5, 0.0])");
    page.value("document.getElementById('view-measure').click()");
    for point in [[1.0, 1.0, 0.0], [3.0, 2.0, 0.0]] {
        let at = place_of(&mut page, point);
        page.click(at, SHIFT);
    }
    let text = page.value("vidarView.measurement().text");
    assert!(text.as_str().unwrap().starts_with("2.236 units: not metric"), "{text}");
}

#[test]
fn keyframes_show_their_pictures_and_can_be_looked_from() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut page = Page::open(&browser, &written(&folder, true), "", WINDOW);
    let keyframe = page.value("vidarView.state().keyframes[0]");
    let position = [0, 1, 2].map(|i| number(&keyframe["position"][i]));
    let at = place_of(&mut page, position);
    page.mouse("mouseMoved", at, 0, 0);
    assert_eq!(page.value("document.getElementById('view-keyframe').hidden"), false, "nothing is shown");
    for picture in ["image", "depth"] {
        page.until(&format!("document.getElementById('view-keyframe-{picture}').naturalWidth > 50"));
    }
    let words = page.value("document.getElementById('view-keyframe').textContent");
    assert!(
        words.as_str().unwrap().contains("Keyframe") && words.as_str().unwrap().contains(" m bright, "),
        "{words}"
    );

    page.click(at, 0);
    let state = page.value("vidarView.state()");
    assert_eq!(state["mode"], "path");
    let eye = [0, 1, 2].map(|i| number(&state["eye"][i]));
    let off = (0..3).map(|i| (eye[i] - position[i]).abs()).fold(0.0, f64::max);
    let shown = page.value("document.querySelector('input[name=view-camera]:checked').value");
    assert!(off < 1e-3 && shown == "path", "{eye:?} {position:?} {shown}");

    // The slider flies along the path, and play goes on by itself.
    page.value("{ const s = document.getElementById('view-time'); s.value = 500; s.dispatchEvent(new Event('input')); }");
    let half_way = page.value("vidarView.state().eye");
    assert_ne!(half_way, state["eye"]);
    page.value("document.getElementById('view-play').click()");
    page.until(&format!("JSON.stringify(vidarView.state().eye) !== '{half_way}'"));
    // Walking goes on from there.
    page.value("document.getElementById('view-canvas').focus()");
    page.key("2");
    assert_eq!(page.value("vidarView.state().mode"), "walk");
    assert_eq!(page.errors, Vec::<String>::new());
}

#[test]
fn without_webgl_the_page_says_so_and_keeps_its_pictures() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut page = Page::open(&browser, &written(&folder, true), "#no-webgl", WINDOW);
    assert_eq!(page.value("document.getElementById('view-body').hidden"), true);
    assert_eq!(page.value("document.getElementById('view-none').hidden"), false);
    assert_eq!(page.value("document.querySelectorAll('figure img').length"), 1);
    assert_eq!(page.errors, Vec::<String>::new());
}

/// Not a test of the view but of a page that a run made: `VIDAR_PAGE=report.html VIDAR_SHOTS=folder cargo test -p vidar-view
/// --test browser -- --ignored` writes the pictures of the documentation and prints the time of a frame.
#[test]
#[ignore = "needs a page in VIDAR_PAGE and a folder in VIDAR_SHOTS"]
fn pictures_of_a_page() {
    let Some(browser) = browser() else { return };
    let file = PathBuf::from(std::env::var("VIDAR_PAGE").unwrap()).canonicalize().unwrap();
    let folder = PathBuf::from(std::env::var("VIDAR_SHOTS").unwrap());
    let mut page = Page::open(&browser, &file, "", (1100, 860));
    let shot = |page: &mut Page, name: &str, script: &str| {
        page.value(script);
        page.value("document.getElementById('view').scrollIntoView({behavior: 'instant'})");
        page.value("new Promise(f => requestAnimationFrame(() => requestAnimationFrame(() => f(1))))");
        std::fs::write(folder.join(format!("{name}.png")), page.screenshot()).unwrap();
    };
    let choose = "const s = document.getElementById('view-coloring'); s.selectedIndex = [...s.options].findIndex(o => !o.disabled && o.value === ";
    let change = "); s.dispatchEvent(new Event('change'));";
    let both = "const p = document.getElementById('view-pane-1'); if (p && !p.checked) p.click();";
    shot(&mut page, "start", "1");
    let state = page.value("vidarView.state()");
    println!("{} triangles, {} points", state["triangles"], state["points"]);
    println!("{} ms a frame", page.value("vidarView.frameTime(20)"));
    page.value("document.getElementById('view-home').click()");
    for coloring in ["height", "confidence", "error", "sigma", "difference"] {
        let has = page.value(&format!(
            "[...document.getElementById('view-coloring').options].some(o => !o.disabled && o.value === '{coloring}')"
        ));
        if has == true {
            shot(&mut page, coloring, &format!("{{ {choose}'{coloring}'{change} }}"));
        }
    }
    shot(&mut page, "beside", &format!("{{ {choose}'color'{change} {both} }}"));
    shot(&mut page, "flight", "document.querySelector('input[name=view-camera][value=path]').click()");
    page.call(
        "Emulation.setEmulatedMedia",
        serde_json::json!({ "features": [{ "name": "prefers-color-scheme", "value": "dark" }] }),
    );
    shot(&mut page, "dark", "document.getElementById('view-home').click()");
    if page.value("vidarView.state().keyframes.length > 0") == true {
        let keyframe =
            page.value("vidarView.state().keyframes[5 % vidarView.state().keyframes.length].position");
        page.value("document.getElementById('view').scrollIntoView({behavior: 'instant'})");
        let at = page.value(&format!(
            "(() => {{ const p = vidarView.project({keyframe}); const b = document.getElementById('view-canvas').getBoundingClientRect();
            return [p.x + b.left, p.y + b.top]; }})()"
        ));
        page.mouse("mouseMoved", (number(&at[0]), number(&at[1])), 0, 0);
        std::fs::write(folder.join("hover.png"), page.screenshot()).unwrap();
    }
    page.call("Emulation.setEmulatedMedia", serde_json::json!({ "features": [] }));
    // A measurement across the first pane.
    page.value("document.getElementById('view-home').click()");
    page.value("document.getElementById('view-measure').click()");
    page.value("document.getElementById('view').scrollIntoView({behavior: 'instant'})");
    let size = page.value(
        "(() => { const b = document.getElementById('view-canvas').getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()",
    );
    let at =
        |x: f64, y: f64| (number(&size[0]) + x * number(&size[2]), number(&size[1]) + y * number(&size[3]));
    page.click(at(0.2, 0.24), 0);
    page.click(at(0.45, 0.22), 0);
    std::fs::write(folder.join("measure.png"), page.screenshot()).unwrap();
    println!("{}, errors: {:?}", page.value("vidarView.measurement()"), page.errors);
}
