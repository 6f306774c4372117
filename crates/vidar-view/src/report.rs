//! The report of one run as one self-contained HTML file: no network, no font, and no script but that of the view.

mod style;

use crate::escape::escaped;
use crate::interactive::{EncodedView, page};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use std::fmt::Write;
use vidar_core::Warning;

/// Level of trust in a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AssessmentLevel {
    /// The requirements are met.
    Good,
    /// The requirements are met with reservations, given in the text.
    Caution,
    /// The requirements are not met.
    Bad,
    /// There was no reference to evaluate it against.
    NotEvaluated,
}

/// One-sentence summary of the quality of a result.
#[derive(Clone, Debug, PartialEq)]
pub struct Assessment {
    /// Level of trust.
    pub level: AssessmentLevel,
    /// Reason, with numbers.
    pub text: String,
}

/// One number at the head of the report.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SummaryItem {
    /// What it is.
    pub label: String,
    /// Its value with unit.
    pub value: String,
    /// Short explanation for new users. May be empty.
    pub explanation: String,
}

/// A table. Columns whose cells all start like a number are set flush right.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Table {
    /// What the table shows.
    pub caption: String,
    /// Head of each column, with units.
    pub columns: Vec<String>,
    /// Cells; the first of a row is its head.
    pub rows: Vec<Vec<String>>,
}

/// Width of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum FigureWidth {
    /// The whole column.
    #[default]
    Full,
    /// Two side by side if the window is wide enough; plots of about 720 columns suit it.
    Half,
}

/// A picture with its caption.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Figure {
    /// The PNG file's bytes.
    pub png: Vec<u8>,
    /// What it shows and what to look for.
    pub caption: String,
    /// Alternative text.
    pub alt: String,
    /// Its width.
    pub width: FigureWidth,
}

/// A part of the report.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Section {
    /// Its heading.
    pub heading: String,
    /// Text, a paragraph each.
    pub paragraphs: Vec<String>,
    /// Tables.
    pub tables: Vec<Table>,
    /// Figures.
    pub figures: Vec<Figure>,
}

/// Content of a report, as plain text with formatted numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Title: usually the dataset.
    pub title: String,
    /// What was done, in one line. May be empty.
    pub subtitle: String,
    /// The assessment, if any.
    pub assessment: Option<Assessment>,
    /// The most important numbers.
    pub summary: Vec<SummaryItem>,
    /// The map in three dimensions, before the sections.
    pub view: Option<EncodedView>,
    /// The parts, in the order of reading.
    pub sections: Vec<Section>,
    /// Warnings.
    pub warnings: Vec<Warning>,
    /// Provenance: name and value (command, version, seed).
    pub provenance: Vec<(String, String)>,
}

/// The report as one self-contained HTML file. All text is escaped, all pictures are inside.
pub fn render_html(report: &Report) -> String {
    let pictures: usize = report.sections.iter().flat_map(|s| &s.figures).map(|f| f.png.len()).sum();
    let view = report.view.as_ref().map_or(0, EncodedView::size_bytes);
    let mut html = String::with_capacity(pictures * 4 / 3 + view + 128 * 1024);
    push_head(&mut html, report);
    push_summary(&mut html, report);
    push_warnings(&mut html, &report.warnings);
    push_contents(&mut html, &report.sections);
    if let Some(view) = &report.view {
        page::push_section(&mut html, view);
    }
    for (i, section) in report.sections.iter().enumerate() {
        push_section(&mut html, i, section);
    }
    push_provenance(&mut html, &report.provenance);
    html.push_str("</main>\n");
    if let Some(view) = &report.view {
        page::push_scripts(&mut html, view);
    }
    html.push_str("</body>\n</html>\n");
    html
}

/// The page may load nothing, from anywhere: browsers enforce it.
const POLICY: &str =
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'";

/// Writing to a `String` cannot fail.
macro_rules! put {
    ($out:expr, $($arg:tt)*) => { { let _ = write!($out, $($arg)*); } };
}

fn push_head(html: &mut String, report: &Report) {
    let title = escaped(&report.title);
    put!(
        html,
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<title>{title}</title>\n\
         <style>\n{}{}</style>\n</head>\n<body>\n<main>\n<header>\n<h1>{title}</h1>\n",
        style::CSS,
        report.view.as_ref().map_or("", |_| page::CSS),
    );
    if !report.subtitle.is_empty() {
        put!(html, "<p class=\"subtitle\">{}</p>\n", escaped(&report.subtitle));
    }
    if let Some(assessment) = &report.assessment {
        let (class, word) = match assessment.level {
            AssessmentLevel::Good => ("good", "Good"),
            AssessmentLevel::Caution => ("caution", "With reservations"),
            AssessmentLevel::Bad => ("bad", "Not met"),
            AssessmentLevel::NotEvaluated => ("not-evaluated", "Not evaluated"),
        };
        let text = escaped(&assessment.text);
        put!(html, "<p class=\"assessment {class}\"><strong>{word}</strong><span>{text}</span></p>\n");
    }
    html.push_str("</header>\n");
}

fn push_summary(html: &mut String, report: &Report) {
    if report.summary.is_empty() {
        return;
    }
    html.push_str("<dl class=\"summary\">\n");
    for item in &report.summary {
        put!(html, "<div><dt>{}</dt><dd class=\"value\">{}</dd>", escaped(&item.label), escaped(&item.value));
        if !item.explanation.is_empty() {
            put!(html, "<dd class=\"why\">{}</dd>", escaped(&item.explanation));
        }
        html.push_str("</div>\n");
    }
    html.push_str("</dl>\n");
}

fn push_warnings(html: &mut String, warnings: &[Warning]) {
    if warnings.is_empty() {
        return;
    }
    let noun = if warnings.len() == 1 { "warning" } else { "warnings" };
    put!(
        html,
        "<section class=\"warnings\" aria-labelledby=\"warnings\">\n<h2 id=\"warnings\">{} {noun}</h2>\n<ul>\n",
        warnings.len()
    );
    for warning in warnings {
        put!(html, "<li><code>{}</code> {}", escaped(&warning.kind), escaped(&warning.message));
        if !warning.place.is_empty() {
            put!(html, " <span class=\"place\">at {}</span>", escaped(&warning.place));
        }
        if let Some(hint) = &warning.hint {
            put!(html, "<br><span class=\"hint\">Hint: {}</span>", escaped(hint));
        }
        html.push_str("</li>\n");
    }
    html.push_str("</ul>\n</section>\n");
}

fn push_contents(html: &mut String, sections: &[Section]) {
    // Two sections need no table of contents.
    if sections.len() < 3 {
        return;
    }
    html.push_str("<nav aria-label=\"Contents\"><ul>\n");
    for (i, section) in sections.iter().enumerate() {
        put!(html, "<li><a href=\"#section-{i}\">{}</a></li>\n", escaped(&section.heading));
    }
    html.push_str("</ul></nav>\n");
}

fn push_section(html: &mut String, index: usize, section: &Section) {
    let heading = escaped(&section.heading);
    put!(html, "<section aria-labelledby=\"section-{index}\">\n<h2 id=\"section-{index}\">{heading}</h2>\n");
    for paragraph in &section.paragraphs {
        put!(html, "<p>{}</p>\n", escaped(paragraph));
    }
    for table in &section.tables {
        push_table(html, table);
    }
    if !section.figures.is_empty() {
        html.push_str("<div class=\"figures\">\n");
        for figure in &section.figures {
            push_figure(html, figure);
        }
        html.push_str("</div>\n");
    }
    html.push_str("</section>\n");
}

fn push_table(html: &mut String, table: &Table) {
    let numeric: Vec<bool> = (0..table.columns.len()).map(|c| is_numeric(table, c)).collect();
    let class = |c: usize| if numeric.get(c) == Some(&true) { " class=\"number\"" } else { "" };
    html.push_str("<div class=\"scroll\"><table>\n");
    if !table.caption.is_empty() {
        put!(html, "<caption>{}</caption>\n", escaped(&table.caption));
    }
    html.push_str("<thead><tr>");
    for (c, column) in table.columns.iter().enumerate() {
        put!(html, "<th scope=\"col\"{}>{}</th>", class(c), escaped(column));
    }
    html.push_str("</tr></thead>\n<tbody>\n");
    for row in &table.rows {
        html.push_str("<tr>");
        // Short rows are filled with empty cells; extra cells are kept.
        for c in 0..row.len().max(table.columns.len()) {
            let cell = row.get(c).map_or_else(String::new, |t| escaped(t));
            if c == 0 {
                put!(html, "<th scope=\"row\"{}>{cell}</th>", class(c));
            } else {
                put!(html, "<td{}>{cell}</td>", class(c));
            }
        }
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody>\n</table></div>\n");
}

/// Whether every filled cell of a column starts like a number or is a dash.
fn is_numeric(table: &Table, column: usize) -> bool {
    let mut cells = table.rows.iter().filter_map(|r| r.get(column)).filter(|c| !c.is_empty()).peekable();
    let starts_like_number = |cell: &String| {
        let body = cell.trim_start_matches(['-', '+', '\u{2212}', '<', '>', '\u{b1}', '\u{2248}', ' ']);
        body.starts_with(|c: char| c.is_ascii_digit())
            || matches!(cell.as_str(), "n/a" | "-" | "\u{2013}" | "NaN")
    };
    cells.peek().is_some() && cells.all(starts_like_number)
}

fn push_figure(html: &mut String, figure: &Figure) {
    let class = match figure.width {
        FigureWidth::Full => "full",
        FigureWidth::Half => "half",
    };
    put!(
        html,
        "<figure class=\"{class}\"><img alt=\"{}\" src=\"data:image/png;base64,",
        escaped(&figure.alt)
    );
    STANDARD.encode_string(&figure.png, html);
    put!(html, "\"><figcaption>{}</figcaption></figure>\n", escaped(&figure.caption));
}

fn push_provenance(html: &mut String, provenance: &[(String, String)]) {
    if provenance.is_empty() {
        return;
    }
    html.push_str("<footer>\n<h2>Provenance</h2>\n<dl>\n");
    for (name, value) in provenance {
        put!(html, "<dt>{}</dt><dd><code>{}</code></dd>\n", escaped(name), escaped(value));
    }
    html.push_str("</dl>\n</footer>\n");
}

#[cfg(test)]
mod tests;
