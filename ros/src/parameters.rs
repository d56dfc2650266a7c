//! Parameters of ROS as values of a configuration: `map.resolution_m` is the key `resolution_m` of `[map]`.

use std::fs::File;
use std::io::Read as _;

use anyhow::{Context, Result, bail};
use saphyr::{LoadableYamlNode as _, Scalar, Yaml};
use toml::{Table, Value};

use crate::arguments::ParameterSource;

/// A file with more than this has no parameters.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// Nodes of ROS have these, and for this one they mean nothing.
const OF_EVERY_NODE: [&str; 2] = ["qos_overrides", "start_type_description_service"];

/// The parameters of a node, as tables of a configuration. `node` is its full name, `/robot1/flockmap`.
pub(crate) fn values(sources: &[ParameterSource], node: &str) -> Result<Table> {
    let mut values = Table::new();
    for source in sources {
        match source {
            ParameterSource::File(path) => {
                let shown = path.display();
                let mut text = String::new();
                File::open(path)
                    .and_then(|file| file.take(FILE_BYTES_MAX + 1).read_to_string(&mut text))
                    .with_context(|| format!("cannot read the parameters in {shown}"))?;
                if text.len() as u64 > FILE_BYTES_MAX {
                    bail!("{shown} is longer than 1 MiB, so no file of parameters");
                }
                of_file(&text, node, &mut values).with_context(|| format!("parameters in {shown}"))?;
            }
            ParameterSource::Given(name, text) => {
                let documents = Yaml::load_from_str(text).with_context(|| format!("-p {name}:={text}"))?;
                let value = documents.first().map_or(Ok(Value::String(String::new())), value);
                set(&mut values, name, value.with_context(|| format!("-p {name}:={text}"))?)?;
            }
        }
    }
    for name in OF_EVERY_NODE {
        values.remove(name);
    }
    // The one parameter of every node that means something here.
    if let Some(is_simulated) = values.remove("use_sim_time") {
        set(&mut values, "ros.use_sim_time", is_simulated)?;
    }
    Ok(values)
}

fn of_file(text: &str, node: &str, values: &mut Table) -> Result<()> {
    let documents = Yaml::load_from_str(text)?;
    for document in &documents {
        of_names(document, "", node, values)?;
    }
    Ok(())
}

/// What a level of names has for the node: names of nodes may be nested, and have wildcards.
fn of_names(yaml: &Yaml<'_>, above: &str, node: &str, values: &mut Table) -> Result<()> {
    let Yaml::Mapping(names) = yaml else {
        bail!("expected names of nodes with `ros__parameters` below them, as ROS 2 has it");
    };
    for (name, inside) in names {
        let name = name_of(name)?;
        if name == "ros__parameters" {
            if fits(&tokens(above), &tokens(node)) {
                let Yaml::Mapping(_) = inside else {
                    bail!("`ros__parameters` of {above} has no parameters")
                };
                add(inside, "", values)?;
            }
        } else {
            of_names(inside, &format!("{above}/{name}"), node, values)?;
        }
    }
    Ok(())
}

fn tokens(name: &str) -> Vec<&str> {
    name.split('/').filter(|token| !token.is_empty()).collect()
}

/// Whether a name with wildcards is that of the node: `*` is one token, `**` any number of them.
fn fits(pattern: &[&str], node: &[&str]) -> bool {
    match (pattern, node) {
        ([], []) => true,
        (["**", rest @ ..], _) => (0..=node.len()).any(|skipped| fits(rest, &node[skipped..])),
        ([first, rest @ ..], [token, tokens @ ..]) => (*first == "*" || first == token) && fits(rest, tokens),
        _ => false,
    }
}

fn add(yaml: &Yaml<'_>, above: &str, values: &mut Table) -> Result<()> {
    let Yaml::Mapping(inside) = yaml else { return set(values, above, value(yaml)?) };
    for (name, yaml) in inside {
        let name = name_of(name)?;
        let full = if above.is_empty() { name } else { format!("{above}.{name}") };
        add(yaml, &full, values).with_context(|| full.clone())?;
    }
    Ok(())
}

/// Sets a value by its name with dots.
fn set(values: &mut Table, name: &str, value: Value) -> Result<()> {
    let (sections, key) = name.rsplit_once('.').map_or(("", name), |(sections, key)| (sections, key));
    let mut table = values;
    for section in sections.split('.').filter(|section| !section.is_empty()) {
        let inside = table.entry(section).or_insert_with(|| Value::Table(Table::new()));
        let Value::Table(inside) = inside else {
            bail!("`{section}` of `{name}` is a value, and no section")
        };
        table = inside;
    }
    table.insert(key.to_owned(), value);
    Ok(())
}

fn name_of(yaml: &Yaml<'_>) -> Result<String> {
    match yaml {
        Yaml::Value(Scalar::String(name)) => Ok(name.to_string()),
        // Robots are named by their numbers.
        Yaml::Value(Scalar::Integer(number)) => Ok(number.to_string()),
        _ => bail!("a name is none, expected a text or a number"),
    }
}

fn value(yaml: &Yaml<'_>) -> Result<Value> {
    Ok(match yaml {
        Yaml::Value(Scalar::Boolean(value)) => Value::Boolean(*value),
        Yaml::Value(Scalar::Integer(value)) => Value::Integer(*value),
        Yaml::Value(Scalar::FloatingPoint(value)) => Value::Float(value.into_inner()),
        Yaml::Value(Scalar::String(value)) => Value::String(value.to_string()),
        Yaml::Sequence(values) => Value::Array(values.iter().map(value).collect::<Result<_>>()?),
        _ => bail!("expected a number, a text, true, false, or a list of these"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(text: &str, node: &str) -> Result<Table> {
        let mut values = Table::new();
        of_file(text, node, &mut values).map(|()| values)
    }

    #[test]
    fn a_file_has_parameters_by_name_and_by_wildcard_and_the_last_counts() {
        let text = "
/**:
  ros__parameters:
    map: {resolution_m: 0.1, range_m: 7}
    ros.map_frame: world
robot1:
  flockmap:
    ros__parameters:
      map.resolution_m: 0.2
      network:
        peers: ['10.0.0.2:7700', '10.0.0.3:7700']
      ros: {teammates: {2: /robot2/pose}}
/robot2/flockmap:
  ros__parameters: {id: 2}
/*/flockmap:
  ros__parameters: {name: any}
";
        let expected = "
            name = 'any'
            map = { resolution_m = 0.2, range_m = 7 }
            network = { peers = ['10.0.0.2:7700', '10.0.0.3:7700'] }
            ros = { map_frame = 'world', teammates = { 2 = '/robot2/pose' } }";
        assert_eq!(of(text, "/robot1/flockmap").unwrap(), expected.parse().unwrap());
        let expected = "map = { resolution_m = 0.1, range_m = 7 }\nros = { map_frame = 'world' }";
        assert_eq!(of(text, "/flockmap").unwrap(), expected.parse().unwrap());
    }

    #[test]
    fn single_parameters_are_yaml_and_use_sim_time_is_that_of_ros() {
        let given = |name: &str, value: &str| ParameterSource::Given(name.into(), value.into());
        let sources = [
            given("id", "3"),
            given("use_sim_time", "true"),
            given("ros.grid_band_m", "[0.1, 1.5]"),
            given("map.range_m", "5.0"),
            given("name", "alpha"),
            given("qos_overrides./tf.subscription.depth", "4"),
        ];
        let expected = "id = 3\nname = 'alpha'\nmap.range_m = 5.0\nros.grid_band_m = [0.1, 1.5]\nros.use_sim_time = true";
        assert_eq!(values(&sources, "/flockmap").unwrap(), expected.parse().unwrap());
    }

    #[test]
    fn what_is_no_file_of_parameters_is_an_error_that_says_where() {
        for (text, part) in [
            ("- 1", "names of nodes"),
            ("/**: {ros__parameters: 5}", "has no parameters"),
            ("/**: {ros__parameters: {a: {b: null}}}", "a.b"),
            ("/**: {ros__parameters: {a: 1, a.b: 2}}", "`a` of `a.b` is a value"),
            ("a: [", ""),
        ] {
            let error = format!("{:#}", of(text, "/flockmap").unwrap_err());
            assert!(error.contains(part), "{text}: {error}");
        }
        let error = values(&[ParameterSource::File("/nowhere.yaml".into())], "/flockmap").unwrap_err();
        assert!(format!("{error:#}").contains("/nowhere.yaml"), "{error:#}");
    }
}
