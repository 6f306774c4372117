//! Every crate that is linked has a licence on the list of `deny.toml`.

use anyhow::{Context, Result};
use cargo_metadata::MetadataCommand;
use std::path::Path;

/// Checks the licence expression of every package of the resolved graph.
pub fn check(root: &Path) -> Result<Vec<String>> {
    let deny = std::fs::read_to_string(root.join("deny.toml")).context("deny.toml")?;
    let (allowed, exceptions) = (allowed(&deny), exceptions(&deny));
    let mut problems = Vec::new();
    let metadata = MetadataCommand::new().manifest_path(root.join("Cargo.toml")).exec()?;
    for package in &metadata.packages {
        let expression = package.license.clone().unwrap_or_default();
        let is_excepted =
            exceptions.iter().any(|(name, licence)| **package.name == *name && expression == *licence);
        if !is_excepted && !satisfied(&expression, &allowed) {
            problems.push(format!(
                "{} {}: licence {expression:?} is not on the list",
                package.name, package.version
            ));
        }
        if package.source.as_ref().is_some_and(|s| !s.is_crates_io()) {
            problems.push(format!("{} {}: comes from outside the registry", package.name, package.version));
        }
    }
    Ok(problems)
}

/// The quoted entries of `allow = [ … ]` under `[licenses]`.
fn allowed(deny: &str) -> Vec<String> {
    let section = deny.split("[licenses]").nth(1).unwrap_or_default();
    let list = section.split("allow = [").nth(1).and_then(|s| s.split(']').next()).unwrap_or_default();
    list.split('"').skip(1).step_by(2).map(str::to_owned).collect()
}

/// Crate and licence of each of `exceptions = [{ crate = "…", allow = ["…"] }, …]` under `[licenses]`.
fn exceptions(deny: &str) -> Vec<(String, String)> {
    let section = deny.split("[licenses]").nth(1).unwrap_or_default();
    let section = section.split("\n[").next().unwrap_or_default();
    let list = section.split("exceptions = [").nth(1).unwrap_or_default();
    let entry = |entry: &str| {
        let mut quoted = entry.split('"').skip(1).step_by(2);
        Some((quoted.next()?.to_owned(), quoted.next()?.to_owned()))
    };
    list.split("crate =").skip(1).filter_map(entry).collect()
}

/// Whether an SPDX expression of `OR`, `AND`, `WITH` and brackets can be met with the allowed licences.
fn satisfied(expression: &str, allowed: &[String]) -> bool {
    // Old manifests write `MIT/Apache-2.0` for `OR`.
    let spaced = expression.replace('/', " OR ").replace('(', " ( ").replace(')', " ) ");
    let tokens: Vec<&str> = spaced.split_whitespace().collect();
    let mut at = 0;
    !tokens.is_empty() && any(&tokens, &mut at, allowed) && at == tokens.len()
}

fn any(tokens: &[&str], at: &mut usize, allowed: &[String]) -> bool {
    let mut met = all(tokens, at, allowed);
    while tokens.get(*at) == Some(&"OR") {
        *at += 1;
        // Both sides are always parsed, so that the position stays right.
        met |= all(tokens, at, allowed);
    }
    met
}

fn all(tokens: &[&str], at: &mut usize, allowed: &[String]) -> bool {
    let mut met = one(tokens, at, allowed);
    while tokens.get(*at) == Some(&"AND") {
        *at += 1;
        met &= one(tokens, at, allowed);
    }
    met
}

fn one(tokens: &[&str], at: &mut usize, allowed: &[String]) -> bool {
    let Some(&token) = tokens.get(*at) else { return false };
    *at += 1;
    if token == "(" {
        let met = any(tokens, at, allowed);
        *at += 1;
        return met;
    }
    let mut name = token.to_owned();
    if tokens.get(*at) == Some(&"WITH") {
        name = format!("{token} WITH {}", tokens.get(*at + 1).unwrap_or(&""));
        *at += 2;
    }
    allowed.contains(&name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spdx_expressions_are_satisfied_by_allowed_licences_only() {
        let allowed: Vec<String> =
            ["MIT", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "Unicode-3.0"].map(Into::into).into();
        for good in [
            "MIT",
            "MIT OR GPL-3.0",
            "GPL-3.0 OR MIT",
            "MIT/Apache-2.0",
            "Apache-2.0 WITH LLVM-exception OR Zlib",
            "(MIT OR GPL-3.0) AND Unicode-3.0",
        ] {
            assert!(satisfied(good, &allowed), "{good}");
        }
        for bad in ["", "GPL-3.0", "MIT AND GPL-3.0", "(GPL-3.0 OR Zlib) AND MIT", "Zlib WITH X"] {
            assert!(!satisfied(bad, &allowed), "{bad}");
        }
    }

    #[test]
    fn the_list_is_read_from_deny_toml() {
        let deny =
            "[bans]\nallow = [\"no\"]\n[licenses]\nconfidence = 0.9\nallow = [\n \"MIT\",\n \"Zlib\",\n]\n";
        assert_eq!(allowed(deny), ["MIT", "Zlib"]);
        assert!(exceptions(deny).is_empty());
        let deny = "[licenses]\nallow = [\"MIT\"]\nexceptions = [{ crate = \"a\", allow = [\"X-1\"] }]\n[bans]\ndeny = [{ crate = \"b\" }]";
        assert_eq!(exceptions(deny), [("a".to_owned(), "X-1".to_owned())]);
    }
}
