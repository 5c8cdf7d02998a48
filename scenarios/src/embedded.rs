//! The shipped scenarios and robots, built into the binary under the names that they have in the
//! repository, so that an installed `rover` works in any folder.

/// A shipped file: its name in the repository and its text.
pub type ShippedFile = (&'static str, &'static str);

/// Shipped scenarios.
pub const SCENARIOS: &[ShippedFile] = &[
    (
        "scenarios/single_cycle.toml",
        include_str!("../single_cycle.toml"),
    ),
    (
        "scenarios/bluestreak.toml",
        include_str!("../bluestreak.toml"),
    ),
    (
        "scenarios/bluestreak_perfect.toml",
        include_str!("../bluestreak_perfect.toml"),
    ),
    (
        "scenarios/bluestreak_occluded.toml",
        include_str!("../bluestreak_occluded.toml"),
    ),
    (
        "scenarios/bluestreak_missed.toml",
        include_str!("../bluestreak_missed.toml"),
    ),
    (
        "scenarios/bluestreak_position.toml",
        include_str!("../bluestreak_position.toml"),
    ),
];

/// Shipped robots.
pub const ROBOTS: &[ShippedFile] = &[
    (
        "scenarios/robots/bluestreak.toml",
        include_str!("../robots/bluestreak.toml"),
    ),
    (
        "scenarios/robots/rocky8.toml",
        include_str!("../robots/rocky8.toml"),
    ),
];

/// Name of the scenario that runs when none is named.
pub const DEFAULT_SCENARIO: &str = "scenarios/single_cycle.toml";

/// The shipped file of that name, with or without its folder.
pub fn find(files: &'static [ShippedFile], name: &str) -> Option<ShippedFile> {
    let name = name.strip_prefix("./").unwrap_or(name);
    let within = |shipped: &str| {
        [shipped, shipped.strip_suffix(".toml").unwrap_or(shipped)]
            .iter()
            .filter_map(|s| s.strip_suffix(name))
            .any(|folder| folder.is_empty() || folder.ends_with('/'))
    };
    let found = |(shipped, _): &&ShippedFile| !name.is_empty() && within(shipped);
    files.iter().find(found).copied()
}

/// The names of the shipped files, for messages.
pub fn names(files: &[ShippedFile]) -> String {
    files
        .iter()
        .map(|(name, _)| *name)
        .collect::<Vec<_>>()
        .join(", ")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn shipped_files_are_found_with_and_without_their_folder() {
        let long = find(SCENARIOS, "scenarios/bluestreak.toml").unwrap();
        assert_eq!(find(SCENARIOS, "bluestreak.toml"), Some(long));
        assert_eq!(find(SCENARIOS, "./scenarios/bluestreak.toml"), Some(long));
        assert!(find(ROBOTS, "robots/bluestreak.toml").is_some());
        assert_eq!(find(SCENARIOS, "bluestreak"), Some(long));
        assert!(find(SCENARIOS, "blue").is_none() && find(SCENARIOS, "streak.toml").is_none());
        assert!(find(SCENARIOS, DEFAULT_SCENARIO).is_some());
    }
}
