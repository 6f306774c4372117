use super::*;
use proptest::prelude::*;

/// As published, with the program's own sections.
const SMALL: &str = r#"{"model_name": "da3-small", "config": {
  "__object__": {"path": "depth_anything_3.model.da3", "name": "DepthAnything3Net", "args": "as_params"},
  "net": {"__object__": {"path": "x", "name": "DinoV2", "args": "as_params"}, "name": "vits",
          "out_layers": [5, 7, 9, 11], "alt_start": 4, "qknorm_start": 4, "rope_start": 4, "cat_token": true},
  "head": {"dim_in": 768, "output_dim": 2, "features": 64, "out_channels": [48, 96, 192, 384]},
  "cam_enc": {"dim_out": 384}, "cam_dec": {"dim_in": 768}}}"#;

const METRIC: &str = r#"{"model_name": "da3metric-large", "config": {
  "net": {"name": "vitl", "out_layers": [4, 11, 17, 23], "alt_start": -1, "qknorm_start": -1, "rope_start": -1},
  "head": {"dim_in": 1024, "output_dim": 1, "features": 256, "out_channels": [256, 512, 1024, 1024]}}}"#;

fn with(from: &str, to: &str) -> Result<Da3Config, Da3Error> {
    assert!(SMALL.contains(from), "{from}");
    parse(&SMALL.replace(from, to), "config.json")
}

#[test]
fn official_descriptions_give_the_official_sizes() {
    assert_eq!(parse(SMALL, "config.json").unwrap(), Variant::Small.config());
    assert_eq!(parse(METRIC, "config.json").unwrap(), Variant::MetricLarge.config());
    for variant in Variant::ALL {
        let by_name = parse(&format!(r#"{{"model_name": "{}"}}"#, variant.name()), "config.json").unwrap();
        assert_eq!(by_name, variant.config());
        by_name.validate().unwrap();
    }
}

#[test]
fn a_network_of_ones_own_is_read_by_its_sizes() {
    let nano = SMALL
        .replace("da3-small", "da3-nano")
        .replace(r#""name": "vits""#, r#""embed_dim": 192, "depth": 12, "num_heads": 3"#)
        .replace(r#""dim_in": 768, "output_dim": 2, "features": 64"#, r#""features": 32"#)
        .replace(r#"{"dim_out": 384}"#, r#"{"num_heads": 4}"#)
        .replace(r#"{"dim_in": 768}"#, "{}");
    let config = parse(&nano, "config.json").unwrap();
    let net = config.main();
    assert_eq!((config.name.as_str(), config.variant), ("da3-nano", None));
    assert_eq!((net.backbone.dim, net.backbone.ffn), (192, Ffn::Mlp { hidden: 768 }));
    assert_eq!((net.head.features, net.camera_encoder.unwrap().heads), (32, 4));
}

#[test]
fn an_official_name_with_other_sizes_is_not_taken_for_the_official_network() {
    let config = with(r#""features": 64"#, r#""features": 48"#).unwrap();
    assert_eq!((config.variant, config.main().head.features), (None, 48));
}

#[test]
fn wrong_sizes_are_named() {
    let cases = [
        (r#""out_layers": [5, 7, 9, 11]"#, r#""out_layers": [5, 7, 9]"#, "net.out_layers is 3 entries"),
        (
            r#""out_layers": [5, 7, 9, 11]"#,
            r#""out_layers": [5, 7, 9, 12]"#,
            "net.out_layers is [5, 7, 9, 12]",
        ),
        (r#""features": 64"#, r#""features": 4000000000"#, "head.features is 4000000000"),
        (r#""features": 64"#, r#""features": 20"#, "a multiple of 8"),
        (r#""name": "vits""#, r#""name": "vitx""#, "net.embed_dim is nothing (net.name is vitx)"),
        (r#""name": "vits""#, r#""name": "vits", "num_heads": 5"#, "a divisor of the width"),
        (r#""alt_start": 4"#, r#""alt_start": 0"#, "net.alt_start is 0, expected 1 to 11"),
        (r#""alt_start": 4"#, r#""alt_start": -1"#, "head.dim_in"),
        (
            r#""dim_in": 768, "output_dim""#,
            r#""dim_in": 700, "output_dim""#,
            "head.dim_in is Some(700), expected 768",
        ),
        (r#"{"dim_out": 384}"#, r#"{"num_heads": 7}"#, "cam_enc.num_heads is 7"),
    ];
    for (from, to, words) in cases {
        let error = with(from, to).unwrap_err().to_string();
        assert!(error.contains(words), "{to}: {error}");
    }
}

#[test]
fn what_is_no_description_is_refused() {
    for text in
        ["", "[]", "{}", r#"{"model_name": "da3-huge"}"#, r#"{"config": {"anyview": {}}}"#, "{\"config\": 1}"]
    {
        assert!(parse(text, "config.json").is_err(), "{text}");
    }
    let deep = format!("{}{}", "{\"config\":{\"anyview\":".repeat(50_000), "}".repeat(100_000));
    assert!(parse(&deep, "config.json").is_err());
    let long = format!(r#"{{"model_name": "{}"}}"#, "x".repeat(2 << 20));
    assert!(matches!(parse(&long, "config.json"), Err(Da3Error::ConfigTooLarge { .. })));
}

proptest! {
    #[test]
    fn numbers_of_any_size_give_an_answer(at in 0usize..30, value in any::<i64>()) {
        // Replaces the n-th number of the description.
        let mut count = 0;
        let mut text = String::new();
        let mut rest = SMALL;
        while let Some(start) = rest.find(|c: char| c.is_ascii_digit()) {
            let end = rest[start..].find(|c: char| !c.is_ascii_digit()).map_or(rest.len(), |e| start + e);
            text.push_str(&rest[..start]);
            let is_it = count == at;
            text.push_str(&if is_it { value.to_string() } else { rest[start..end].to_owned() });
            count += 1;
            rest = &rest[end..];
        }
        text.push_str(rest);
        if let Ok(config) = parse(&text, "config.json") {
            prop_assert!(config.validate().is_ok());
        }
    }
}
