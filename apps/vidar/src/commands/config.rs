//! `vidar config`.

use crate::shared_args::ConfigArgs;
use crate::{Context, Outcome, build, print};
use serde_json::json;
use vidar::ExitStatus;
use vidar::config::{self, PRESETS};

/// Every setting with its value.
pub fn show(args: &ConfigArgs, origin: bool, context: &Context) -> Outcome {
    let layered = build::layered(args, None)?;
    layered.build()?;
    if context.cli.json {
        let rows: Vec<_> = layered
            .entries()
            .into_iter()
            .map(|(key, value, from)| json!({ "key": key, "value": value, "origin": from.to_string() }))
            .collect();
        print::json(&json!({ "schema": "vidar.config/1", "settings": rows }));
    } else {
        print::data(layered.to_toml(origin).trim_end());
    }
    Ok(ExitStatus::Done)
}

/// What a setting means.
pub fn explain(key: &str, context: &Context) -> Outcome {
    let found = config::explain(key)?;
    if context.cli.json {
        let rows: Vec<_> =
            found.iter().map(|e| json!({ "key": e.key, "about": e.about, "default": e.default })).collect();
        print::json(&json!({ "schema": "vidar.config/1", "settings": rows }));
        return Ok(ExitStatus::Done);
    }
    for explanation in &found {
        print::data(format!("{} (default {})", explanation.key, explanation.default));
        print::data(format!("  {}", explanation.about));
    }
    Ok(ExitStatus::Done)
}

/// Presets and when to use them.
pub fn presets(context: &Context) -> Outcome {
    if context.cli.json {
        let rows: Vec<_> = PRESETS.iter().map(|p| json!({ "name": p.name, "about": p.about })).collect();
        print::json(&json!({ "schema": "vidar.config/1", "presets": rows }));
    } else {
        print::pairs(PRESETS.iter().map(|p| (p.name, p.about.to_owned())));
    }
    Ok(ExitStatus::Done)
}

/// JSON schema of the configuration.
pub fn schema() -> Outcome {
    print::json(&config::schema());
    Ok(ExitStatus::Done)
}
