//! The swarm key: where it comes from.

use std::path::Path;

use flockmap::sync::SwarmKey;
use flockmap_store::others_may;
use schemars::JsonSchema;
use serde::Deserialize;

use super::NodeConfig;
use super::convert::value;
use super::error::ConfigError;
use super::parse::read_text;

/// The environment variable that may hold the key.
pub const KEY_VARIABLE: &str = "FLOCKMAP_SWARM_KEY";

/// A file with more than this is no key.
const FILE_BYTES_MAX: u64 = 4_096;

/// A text that is never printed.
#[derive(Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Secret(String);

impl Secret {
    pub(super) fn text(&self) -> &str {
        &self.0
    }
}

impl std::fmt::Debug for Secret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Secret")
    }
}

/// The key of a configuration, and what is to be said of it.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct FoundKey {
    /// The key.
    pub key: SwarmKey,
    /// Where it was found.
    pub place: String,
    /// What makes it less of a secret, if anything.
    pub warning: Option<String>,
}

impl NodeConfig {
    /// The swarm key, from the one place that has it: the configuration itself (read from `config_path`), a
    /// file, or the environment variable, whose value is `variable`.
    ///
    /// # Errors
    /// More than one place has a key, or what stands there is none. The text never contains it.
    pub fn swarm_key(
        &self,
        config_path: &Path,
        variable: Option<&str>,
    ) -> Result<Option<FoundKey>, ConfigError> {
        let places = [
            ("[session] swarm_key", self.swarm_key.is_some()),
            ("[session] swarm_key_file", self.swarm_key_file.is_some()),
            (KEY_VARIABLE, variable.is_some()),
        ];
        let given: Vec<&str> =
            places.iter().filter(|(_, is_given)| *is_given).map(|(name, _)| *name).collect();
        if let [first, second, ..] = given[..] {
            return Err(value(first, format!("given, and {second} too"), "the swarm key in one place"));
        }
        if let Some(Secret(text)) = &self.swarm_key {
            return found("[session] swarm_key", text, "the configuration".into(), Some(config_path))
                .map(Some);
        }
        if let Some(text) = variable {
            return found(KEY_VARIABLE, text, format!("the environment ({KEY_VARIABLE})"), None).map(Some);
        }
        let Some(path) = &self.swarm_key_file else { return Ok(None) };
        let name = "[session] swarm_key_file";
        let fail = |error: std::io::Error| {
            value(name, format!("\"{}\" ({error})", path.display()), "a file that can be read")
        };
        let Some(text) = read_text(path, FILE_BYTES_MAX).map_err(fail)? else {
            return Err(value(name, format!("\"{}\"", path.display()), "a file with nothing but the key"));
        };
        found(name, &text, path.display().to_string(), Some(path)).map(Some)
    }
}

fn found(name: &str, text: &str, place: String, file: Option<&Path>) -> Result<FoundKey, ConfigError> {
    let key = text.parse().map_err(|error| {
        // The error says what was expected as well, and not what the text is.
        ConfigError::Key { key: name.to_owned(), place: place.clone(), error }
    })?;
    let warning = file.filter(|file| others_may(file, 0o044)).map(|file| {
        let file = file.display();
        format!("{file} holds the swarm key and other users of this machine can read it: chmod 600 {file}")
    });
    Ok(FoundKey { key, place, warning })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEX: &str = "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f";

    fn config(session: &str) -> NodeConfig {
        format!("id = 1\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n[session]\n{session}").parse().unwrap()
    }

    fn find(session: &str, variable: Option<&str>) -> Result<Option<FoundKey>, String> {
        config(session).swarm_key(Path::new("/nowhere"), variable).map_err(|error| error.to_string())
    }

    #[test]
    fn a_key_comes_from_one_place() {
        let folder = std::env::temp_dir().join(format!("flockmap-key-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("swarm.key");
        std::fs::write(&file, format!("{HEX}\n")).unwrap();
        let in_config = format!("swarm_key = \"{HEX}\"\n");
        let in_file = format!("swarm_key_file = \"{}\"\n", file.display());

        assert_eq!(find("", None), Ok(None));
        let key: SwarmKey = HEX.parse().unwrap();
        for (session, variable) in [(&in_config, None), (&in_file, None), (&String::new(), Some(HEX))] {
            assert_eq!(find(session, variable).unwrap().unwrap().key, key);
        }
        let both = in_config.clone() + &in_file;
        for (session, variable, names) in [
            (&both, None, ["[session] swarm_key is", "[session] swarm_key_file too"]),
            (&in_config, Some(HEX), ["[session] swarm_key is", "FLOCKMAP_SWARM_KEY too"]),
            (&in_file, Some(HEX), ["[session] swarm_key_file is", "FLOCKMAP_SWARM_KEY too"]),
        ] {
            let error = find(session, variable).unwrap_err();
            assert!(names.iter().all(|name| error.contains(name)), "{error}");
        }
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn what_is_no_key_is_named_by_its_place_and_not_printed() {
        let nearly = &HEX[1..];
        let error = find(&format!("swarm_key = \"{nearly}\""), None).unwrap_err();
        assert!(error.starts_with("[session] swarm_key") && error.contains("63 characters"), "{error}");
        assert!(error.contains("flockmap key") && !error.contains(nearly), "{error}");
        let error = find("swarm_key_file = \"/nowhere/swarm.key\"", None).unwrap_err();
        assert!(error.contains("/nowhere/swarm.key") && error.contains("can be read"), "{error}");
        assert!(find("", Some("")).unwrap_err().contains("FLOCKMAP_SWARM_KEY"));
        let printed = format!("{:?}", config(&format!("swarm_key = \"{HEX}\"")));
        assert!(!printed.contains(HEX), "{printed}");
    }

    #[cfg(unix)]
    #[test]
    fn a_key_that_others_can_read_gets_a_warning() {
        use std::os::unix::fs::PermissionsExt;
        let folder = std::env::temp_dir().join(format!("flockmap-key-mode-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("swarm.key");
        std::fs::write(&file, HEX).unwrap();
        let session = format!("swarm_key_file = \"{}\"", file.display());
        for (mode, is_warned) in [(0o600, false), (0o400, false), (0o640, true), (0o604, true), (0o644, true)]
        {
            std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
            let warning = find(&session, None).unwrap().unwrap().warning;
            assert_eq!(warning.is_some(), is_warned, "{mode:o}: {warning:?}");
        }
        // The configuration is such a file too if the key stands in it.
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o644)).unwrap();
        let found = config(&format!("swarm_key = \"{HEX}\"")).swarm_key(&file, None).unwrap().unwrap();
        assert!(found.warning.unwrap().contains("chmod 600"));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
