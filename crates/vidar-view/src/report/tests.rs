use super::*;

fn full_report() -> Report {
    let evil = "<script>alert(\"1\")</script> & 'quotes'".to_owned();
    Report {
        title: evil.clone(),
        subtitle: evil.clone(),
        assessment: Some(Assessment { level: AssessmentLevel::Caution, text: evil.clone() }),
        summary: vec![SummaryItem { label: evil.clone(), value: evil.clone(), explanation: evil.clone() }],
        sections: ["One", "Two", evil.as_str()]
            .map(|heading| Section {
                heading: heading.to_owned(),
                paragraphs: vec![evil.clone()],
                tables: vec![Table {
                    caption: evil.clone(),
                    columns: vec!["Measure".to_owned(), "Value [m]".to_owned(), evil.clone()],
                    rows: vec![
                        vec!["ATE".to_owned(), "0.04".to_owned(), evil.clone()],
                        vec!["RPE".to_owned()],
                    ],
                }],
                figures: vec![Figure {
                    png: vec![137, 80, 78, 71, 0, 255],
                    caption: evil.clone(),
                    alt: evil.clone(),
                    width: FigureWidth::Half,
                }],
            })
            .to_vec(),
        warnings: vec![Warning::new(&evil, &evil).at(&evil).hint(&evil)],
        provenance: vec![(evil.clone(), evil)],
        view: None,
    }
}

#[test]
fn markup_in_any_text_is_escaped() {
    let html = render_html(&full_report());
    assert!(!html.contains("<script"));
    assert!(html.contains("&lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt; &amp; &#39;quotes&#39;"));
    // Nothing but our own attributes: every quote that opened an attribute is closed.
    assert_eq!(html.matches('"').count() % 2, 0);
}

#[test]
fn the_file_needs_nothing_from_outside() {
    let html = render_html(&full_report());
    for foreign in ["http://", "https://", "//cdn", "@import", "url(", "<link", "<iframe"] {
        assert!(!html.contains(foreign), "{foreign}");
    }
    let sources = html.split("src=\"").skip(1);
    assert_eq!(sources.clone().count(), 3);
    for source in sources {
        let encoded = source.strip_prefix("data:image/png;base64,").unwrap();
        let bytes = STANDARD.decode(encoded.split('"').next().unwrap()).unwrap();
        assert_eq!(bytes, [137, 80, 78, 71, 0, 255]);
    }
}

#[test]
fn every_opened_element_is_closed_in_order() {
    let html = render_html(&full_report());
    let void = ["meta", "img", "br", "!DOCTYPE"];
    let mut open: Vec<&str> = Vec::new();
    for tag in html.split('<').skip(1) {
        let name = tag.split(['>', ' ', '\n']).next().unwrap();
        if let Some(closed) = name.strip_prefix('/') {
            assert_eq!(open.pop(), Some(closed));
        } else if !void.contains(&name) {
            open.push(name);
        }
    }
    assert!(open.is_empty(), "{open:?}");
}

#[test]
fn pictures_have_texts_and_tables_have_heads() {
    let html = render_html(&full_report());
    assert_eq!(html.matches("<img alt=\"&lt;script").count(), 3);
    assert_eq!(html.matches("<th scope=\"col\"").count(), 9);
    assert_eq!(html.matches("<th scope=\"row\"").count(), 6);
    // A short row is filled up to the width of the head.
    assert!(html.contains("<th scope=\"row\">RPE</th><td class=\"number\"></td><td></td></tr>"));
    // Contents lead to headings that exist.
    for i in 0..3 {
        assert!(
            html.contains(&format!("href=\"#section-{i}\"")) && html.contains(&format!("id=\"section-{i}\""))
        );
    }
}

#[test]
fn numeric_columns_are_detected() {
    let table = Table {
        caption: String::new(),
        columns: vec!["a".to_owned(); 3],
        rows: vec![
            vec!["-1.5 m".to_owned(), "mesh".to_owned(), "n/a".to_owned()],
            vec!["2".to_owned(), "3 d".to_owned(), String::new()],
        ],
    };
    assert_eq!([0, 1, 2].map(|c| is_numeric(&table, c)), [true, false, true]);
}

#[test]
fn an_empty_report_is_still_a_page() {
    let html = render_html(&Report::default());
    assert!(html.starts_with("<!DOCTYPE html>") && html.ends_with("</html>\n"));
    assert!(!html.contains("<dl") && !html.contains("<nav") && !html.contains("<footer"));
}
