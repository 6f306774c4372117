//! Circles of files: modules of a crate that import each other, directly or through others.
//!
//! A child may import from its ancestors (`use super::Type`), which are the façade of their children; all other circles are
//! counted. [`MOST`] only goes down.

use anyhow::{Context, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Most circles in the workspace.
const MOST: usize = 6;

type Module = Vec<String>;

/// Reports the circles where there are more than [`MOST`].
pub fn check(root: &Path) -> Result<Vec<String>> {
    let mut circles = Vec::new();
    for crates in ["crates", "apps"] {
        for folder in std::fs::read_dir(root.join(crates)).context(crates)? {
            let folder = folder?.path();
            for circle in circles_of(&modules(&folder.join("src"))?) {
                let names: Vec<String> = circle.iter().map(|m| m.join("::")).collect();
                circles.push(format!("{}: {}", folder.display(), names.join(", ")));
            }
        }
    }
    circles.sort();
    let count = circles.len();
    if count <= MOST {
        return Ok(Vec::new());
    }
    circles.push(format!("{count} circles of files that import each other, at most {MOST} are allowed"));
    Ok(circles)
}

/// Each module with the modules that it imports from.
fn modules(src: &Path) -> Result<BTreeMap<Module, BTreeSet<Module>>> {
    let mut texts: BTreeMap<Module, String> = BTreeMap::new();
    let mut folders = vec![src.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).with_context(|| folder.display().to_string())? {
            let path: PathBuf = entry?.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") && !path.ends_with("tests.rs") {
                let relative = path.strip_prefix(src)?.with_extension("");
                let mut name: Module =
                    relative.iter().map(|part| part.to_string_lossy().into_owned()).collect();
                if matches!(name.last().map(String::as_str), Some("mod" | "lib" | "main")) {
                    name.pop();
                }
                let text = std::fs::read_to_string(&path)?;
                let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
                let code: Vec<&str> =
                    code.lines().map(|l| l.split("//").next().unwrap_or_default()).collect();
                texts.insert(name, code.join("\n"));
            }
        }
    }
    let imports = |(module, code): (&Module, &String)| {
        let found = paths(code).into_iter().filter_map(|path| resolve(module, &path, &texts));
        // From an ancestor, or from the crate's root, everything may be imported.
        (module.clone(), found.filter(|m| !module.starts_with(m)).collect())
    };
    Ok(texts.iter().map(imports).collect())
}

/// The paths of all imports, braces resolved, and those written out in the code.
fn paths(code: &str) -> Vec<Vec<String>> {
    let (mut found, mut rest) = (Vec::new(), String::new());
    let mut lines = code.lines();
    while let Some(line) = lines.next() {
        let statement = line.trim_start();
        let is_export = statement.starts_with("pub") && statement.contains(" use ");
        if !(is_export || statement.starts_with("use ")) {
            rest.push_str(line);
            rest.push('\n');
            continue;
        }
        let mut import = statement.to_owned();
        while !import.contains(';') {
            let Some(line) = lines.next() else { break };
            import.push_str(line);
        }
        // What a module exports again, it does not work with.
        if let Some((tree, _)) = import.strip_prefix("use ").and_then(|i| i.split_once(';')) {
            expand(&[], tree, &mut found);
        }
    }
    for start in ["crate::", "super::"] {
        for (at, _) in rest.match_indices(start) {
            let end = rest[at..].find(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':'));
            let path = &rest[at..end.map_or(rest.len(), |e| at + e)];
            found.push(path.split("::").map(str::to_owned).collect());
        }
    }
    found
}

fn expand(prefix: &[String], tree: &str, found: &mut Vec<Vec<String>>) {
    let (mut depth, mut start) = (0_usize, 0);
    let ends = tree.char_indices().chain([(tree.len(), ',')]);
    for (at, c) in ends {
        match c {
            '{' => depth += 1,
            '}' => depth = depth.saturating_sub(1),
            ',' if depth == 0 => {
                let part = tree[start..at].trim();
                start = at + 1;
                let (head, inner) = match part.split_once('{') {
                    Some((head, inner)) => (head, inner.rsplit_once('}').map(|p| p.0)),
                    None => (part.split(" as ").next().unwrap_or_default(), None),
                };
                let names = head.split("::").map(str::trim).filter(|n| !n.is_empty()).map(str::to_owned);
                let path: Vec<String> = prefix.iter().cloned().chain(names).collect();
                match inner {
                    Some(inner) => expand(&path, inner, found),
                    None => found.push(path),
                }
            }
            _ => {}
        }
    }
}

/// The module that a path leads to; none where it leads out of the crate.
fn resolve(module: &Module, path: &[String], all: &BTreeMap<Module, String>) -> Option<Module> {
    let mut target: Module = match path.first()?.as_str() {
        "crate" => path[1..].to_vec(),
        "super" | "self" => {
            let ups = path.iter().take_while(|p| *p == "super").count();
            let kept = module.len().checked_sub(ups)?;
            let skipped = ups.max(usize::from(path[0] == "self"));
            module[..kept].iter().chain(&path[skipped..]).cloned().collect()
        }
        child => {
            let own: Module = module.iter().cloned().chain([child.to_owned()]).collect();
            all.contains_key(&own).then(|| module.iter().chain(path).cloned().collect())?
        }
    };
    while !all.contains_key(&target) {
        target.pop()?;
    }
    Some(target)
}

/// Groups of modules each of which reaches each other.
fn circles_of(imports: &BTreeMap<Module, BTreeSet<Module>>) -> Vec<BTreeSet<Module>> {
    let reach = |from: &Module| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
        while let Some(next) = open.pop() {
            open.extend(imports.get(next).into_iter().flatten().filter(|m| seen.insert((*m).clone())));
        }
        seen
    };
    let reached: BTreeMap<&Module, BTreeSet<Module>> = imports.keys().map(|m| (m, reach(m))).collect();
    let circle = |m: &Module| -> BTreeSet<Module> {
        let mutual = reached[m].iter().filter(|other| reached.get(other).is_some_and(|r| r.contains(m)));
        mutual.cloned().collect()
    };
    let all: BTreeSet<BTreeSet<Module>> = imports.keys().map(circle).filter(|c| c.len() > 1).collect();
    all.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn imports_are_read_and_circles_found() {
        let names = |code: &str| -> Vec<String> { paths(code).iter().map(|p| p.join("::")).collect() };
        assert_eq!(
            names("use crate::a::{self, b::C as D};\nlet x = super::e::f(1);"),
            ["crate::a::self", "crate::a::b::C", "super::e::f"]
        );
        let module = |name: &str| vec![name.to_owned()];
        let imports = BTreeMap::from([
            (module("a"), BTreeSet::from([module("b")])),
            (module("b"), BTreeSet::from([module("c")])),
            (module("c"), BTreeSet::from([module("a")])),
            (module("d"), BTreeSet::from([module("a")])),
        ]);
        let circles = circles_of(&imports);
        assert_eq!(circles, [BTreeSet::from([module("a"), module("b"), module("c")])]);
    }
}
