//! The steps of the robust method use those before them alone.

use std::fs;
use std::path::{Path, PathBuf};

/// From what is given to what is found, as `src/robust/mod.rs` says.
const STEPS: [&str; 11] =
    ["parts", "settings", "scene", "noise", "model", "energy", "learn", "search", "initial", "calibrate", "finish"];

fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok).map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

/// The steps that the code of a file names, but for its tests.
fn named(code: &str) -> Vec<&str> {
    let code = code.split("#[cfg(test)]").next().unwrap_or_default();
    let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
    let after = lines.flat_map(|line| line.split("crate::robust::").skip(1));
    after.map(|rest| rest.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap_or_default()).collect()
}

#[test]
fn each_step_uses_those_before_it_alone() {
    let method = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/robust");
    let place = |step: &str| STEPS.iter().position(|other| *other == step);
    let mut asked = 0;
    for path in files(&method).iter().filter(|path| **path != method.join("mod.rs")) {
        let inside = path.strip_prefix(&method).map(|path| path.with_extension("")).unwrap_or_default();
        let step = inside.iter().next().and_then(|step| step.to_str()).unwrap_or_default();
        let here = place(step);
        assert!(here.is_some(), "{} is no step", path.display());
        for other in named(&fs::read_to_string(path).unwrap_or_default()) {
            assert!(place(other).is_some_and(|there| Some(there) <= here), "{} uses {other}", path.display());
            asked += 1;
        }
    }
    assert!(asked > 100, "{asked}");
}
