//! The view's controls as HTML, and its scripts and styles.

use super::{EncodedView, FieldKind, FieldValues, InteractiveView, PanesShown, PathRole};
use crate::escape::escaped;
use std::fmt::Write;

/// The scripts in the order in which they define what the later ones use. They share one function scope.
const SCRIPTS: [&str; 12] = [
    include_str!("js/algebra.js"),
    include_str!("js/decode.js"),
    include_str!("js/shaders.js"),
    include_str!("js/camera.js"),
    include_str!("js/surface.js"),
    include_str!("js/lines.js"),
    include_str!("js/measure.js"),
    include_str!("js/overlay.js"),
    include_str!("js/view.js"),
    include_str!("js/input.js"),
    include_str!("js/controls.js"),
    include_str!("js/start.js"),
];

/// Styles of the view, after those of the report.
pub(crate) const CSS: &str = include_str!("js/view.css");

/// What the reader can choose.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Controls {
    panes: Vec<String>,
    all_shown: bool,
    coloring: Option<&'static str>,
    /// Of every kind of value: its name, whether a pane has it, and else why not.
    fields: Vec<(&'static str, &'static str, Option<String>)>,
    has_mesh: bool,
    has_cloud: bool,
    has_truth: bool,
    has_path: bool,
    has_keyframes: bool,
}

impl Controls {
    pub(super) fn of(view: &InteractiveView<'_>) -> Self {
        let any = |f: &dyn Fn(&super::Pane<'_>) -> bool| view.panes.iter().any(f);
        let fields = FieldKind::ALL.iter().filter_map(|&kind| {
            let mut of_kind = view.panes.iter().flat_map(|p| &p.fields).filter(|f| f.kind == kind).peekable();
            of_kind.peek()?;
            let mut reason = None;
            for field in of_kind {
                match &field.values {
                    FieldValues::Missing(why) => reason = reason.or(Some(why.clone())),
                    FieldValues::Own | FieldValues::Samples { .. } => {
                        return Some((kind.id(), name(kind), None));
                    }
                }
            }
            Some((kind.id(), name(kind), Some(reason.unwrap_or_default())))
        });
        Self {
            panes: view.panes.iter().map(|p| p.name.clone()).collect(),
            all_shown: view.shown == PanesShown::All,
            coloring: view.coloring.map(FieldKind::id),
            fields: fields.collect(),
            has_mesh: any(&|p| p.mesh.is_some_and(|m| !m.triangles.is_empty())),
            has_cloud: any(&|p| p.cloud.is_some_and(|c| !c.is_empty())),
            has_truth: any(&|p| p.paths.iter().any(|path| path.role == PathRole::Truth)),
            has_path: any(&|p| p.paths.iter().any(|path| path.role == PathRole::Estimate)),
            has_keyframes: any(&|p| !p.keyframes.is_empty()),
        }
    }
}

fn name(kind: FieldKind) -> &'static str {
    match kind {
        FieldKind::Confidence => "confidence",
        FieldKind::Error => "error: distance to the reference",
        FieldKind::Sigma => "sigma: standard deviation of depth",
        FieldKind::Difference => "difference: distance to the other surface",
    }
}

/// The section with the view.
pub(crate) fn push_section(html: &mut String, view: &EncodedView) {
    let c = &view.controls;
    html.push_str(
        "<section id=\"view\" class=\"view\" aria-labelledby=\"view-heading\">\n<h2 id=\"view-heading\">In three dimensions</h2>\n\
         <noscript><p>The view needs scripts, which are switched off; the pictures below show the same.</p></noscript>\n\
         <p id=\"view-none\" hidden>This browser has no WebGL; the pictures below show the same.</p>\n\
         <div id=\"view-body\" hidden>\n<div class=\"view-bar\" role=\"toolbar\" aria-label=\"Camera and tools\">\n\
         <fieldset><legend>Camera</legend>\n",
    );
    for (value, text, enabled) in
        [("orbit", "Orbit", true), ("walk", "First person", true), ("path", "Along the path", c.has_path)]
    {
        let state = match (value, enabled) {
            ("orbit", _) => " checked",
            (_, true) => "",
            (_, false) => " disabled",
        };
        let _ = writeln!(
            html,
            "<label><input type=\"radio\" name=\"view-camera\" value=\"{value}\"{state}> {text}</label>"
        );
    }
    html.push_str(
        "</fieldset>\n<span class=\"view-buttons\"><button type=\"button\" id=\"view-home\">Whole map</button>\n\
         <button type=\"button\" id=\"view-top\">From above</button>\n\
         <button type=\"button\" id=\"view-measure\" aria-pressed=\"false\">Measure</button>\n\
         <button type=\"button\" id=\"view-full\">Full screen</button></span>\n",
    );
    push_coloring(html, c);
    html.push_str("</div>\n");
    push_stage(html);
    push_flight(html, c);
    html.push_str("<p id=\"view-status\" role=\"status\" aria-live=\"polite\"></p>\n");
    push_options(html, c);
    push_help(html);
    html.push_str("</div>\n</section>\n");
}

fn push_coloring(html: &mut String, c: &Controls) {
    html.push_str("<label class=\"view-coloring\">Colour by <select id=\"view-coloring\">\n");
    let mut option = |value: &str, text: &str, reason: Option<&str>| {
        let selected = if c.coloring == Some(value) { " selected" } else { "" };
        let _ = match reason {
            None => writeln!(html, "<option value=\"{value}\"{selected}>{text}</option>"),
            Some(why) => {
                writeln!(
                    html,
                    "<option value=\"{value}\" disabled>{text} (not available: {})</option>",
                    escaped(why)
                )
            }
        };
    };
    option("color", "images", None);
    option("height", "height", None);
    for (id, text, reason) in &c.fields {
        option(id, text, reason.as_deref());
    }
    html.push_str("</select></label>\n");
}

fn push_stage(html: &mut String) {
    html.push_str(
        "<div id=\"view-stage\" class=\"view-stage\">\n\
         <canvas id=\"view-canvas\" tabindex=\"0\" role=\"application\" aria-label=\"The map in three dimensions\" aria-describedby=\"view-keys view-status\"></canvas>\n\
         <canvas id=\"view-overlay\" aria-hidden=\"true\"></canvas>\n\
         <div id=\"view-keyframe\" class=\"view-keyframe\" hidden>\n<p id=\"view-keyframe-name\"></p>\n\
         <img id=\"view-keyframe-image\" alt=\"Image of the keyframe\"><img id=\"view-keyframe-depth\" alt=\"Depth of the keyframe: near is bright, far is dark\">\n\
         <p id=\"view-keyframe-depth-range\"></p></div>\n\
         <p id=\"view-hint\" class=\"view-hint\" hidden>Click the view, then the wheel zooms.</p>\n</div>\n",
    );
}

/// Controls of the flight along the path.
fn push_flight(html: &mut String, c: &Controls) {
    if !c.has_path {
        return;
    }
    html.push_str(
        "<div id=\"view-flight\" class=\"view-flight\" hidden>\n<button type=\"button\" id=\"view-play\" aria-pressed=\"false\">Play</button>\n\
         <label>Time <input type=\"range\" id=\"view-time\" min=\"0\" max=\"1000\" value=\"0\" step=\"1\"></label>\n\
         <output id=\"view-time-text\" for=\"view-time\"></output>\n</div>\n",
    );
}

fn push_options(html: &mut String, c: &Controls) {
    html.push_str("<fieldset class=\"view-options\"><legend>Show</legend>\n");
    let mut tick = |id: &str, text: &str, on: bool| {
        let checked = if on { " checked" } else { "" };
        let _ = writeln!(html, "<label><input type=\"checkbox\" id=\"{id}\"{checked}> {text}</label>");
    };
    if c.has_mesh {
        tick("view-show-mesh", "mesh", true);
    }
    if c.has_cloud {
        tick("view-show-cloud", "points", !c.has_mesh);
    }
    if c.has_path {
        tick("view-show-path", "trajectory", true);
    }
    if c.has_truth {
        tick("view-show-truth", "ground truth", true);
    }
    if c.has_keyframes {
        tick("view-show-keyframes", "keyframes", true);
    }
    tick("view-inside", "look through walls from outside", true);
    tick("view-parallel", "parallel projection", false);
    if c.panes.len() > 1 {
        tick("view-linked", "link cameras", true);
        for (i, pane) in c.panes.iter().enumerate() {
            tick(&format!("view-pane-{i}"), &escaped(pane), c.all_shown || i == 0);
        }
    }
    html.push_str(
        "<label class=\"view-cut\">cut above <input type=\"range\" id=\"view-cut\" min=\"0\" max=\"100\" value=\"100\" step=\"1\"> \
         <output id=\"view-cut-text\" for=\"view-cut\">nothing</output></label>\n</fieldset>\n",
    );
}

fn push_help(html: &mut String) {
    html.push_str(
        "<details class=\"view-help\"><summary>Mouse and keys</summary>\n<p id=\"view-keys\">Drag to turn, drag with the right button or Shift to move, \
         wheel to zoom; double click to turn about a point. Point at a keyframe to see its image and depth; click it to look from there. \
         Keys: arrows turn, Page Up and Page Down or plus and minus zoom, W A S D Q E move, Home shows the whole map, T shows it from above, \
         1 2 3 choose the camera, C changes colours, M measures between two points: click them, or aim the cross in the middle and press Enter; \
         with Shift a click takes the nearest vertex; Escape ends. P plays the flight.</p></details>\n",
    );
}

/// The data and the scripts, at the end of the page.
pub(crate) fn push_scripts(html: &mut String, view: &EncodedView) {
    html.push_str("<script type=\"application/json\" id=\"view-data\">");
    html.push_str(&view.json);
    html.push_str("</script>\n<script>\n(function () {\n\"use strict\";\n");
    SCRIPTS.iter().for_each(|script| html.push_str(script));
    html.push_str("}());\n</script>\n");
}
