//! The configuration as a JSON schema, with which editors complete and check keys.

use schemars::generate::SchemaSettings;
use serde_json::{Value, json};

use super::NodeConfig;

/// Keys of the node that stand in sections of the robot's options. They are read as keys of the whole file.
pub(super) const OWN_KEYS: [(&str, &str); 5] = [
    ("map", "mapper"),
    ("session", "behaviour"),
    ("session", "swarm_key"),
    ("session", "swarm_key_file"),
    ("fusion", "muted"),
];

/// Keys of `[map]` that no preset can have.
pub(super) const REQUIRED: [&str; 2] = ["resolution_m", "range_m"];

/// The JSON schema of a configuration file.
pub fn schema() -> Value {
    let settings = SchemaSettings::draft07().with(|settings| settings.inline_subschemas = true);
    let mut schema = settings.into_generator().into_root_schema_for::<NodeConfig>().to_value();
    let properties = &mut schema["properties"];
    for (section, key) in OWN_KEYS {
        properties[section]["properties"][key] = properties[format!("{section}.{key}")].take();
    }
    if let Some(properties) = properties.as_object_mut() {
        properties.retain(|_, property| !property.is_null());
    }
    // The preset has the others.
    schema["properties"]["map"]["required"] = json!(REQUIRED);
    schema
}
