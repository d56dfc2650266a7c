//! The arguments that every node of ROS 2 takes, behind `--ros-args`: as `ros2 run` and launch files give them.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};

/// What stood behind `--ros-args`.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub(crate) struct RosArguments {
    /// `-r __ns:=/robot1`
    pub(crate) namespace: Option<String>,
    /// `-r __node:=mapper`
    pub(crate) node: Option<String>,
    /// `-r points:=/lidar/points`, in the order given; the first that fits counts.
    pub(crate) remaps: Vec<Remap>,
    /// `--params-file FILE` and `-p name:=value`, in the order given; the last of a name counts.
    pub(crate) parameters: Vec<ParameterSource>,
    /// What is taken and has no effect here.
    pub(crate) ignored: Vec<String>,
}

/// A name to be used in place of another one.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Remap {
    /// Only for the node of this name.
    pub(crate) node: Option<String>,
    pub(crate) from: String,
    pub(crate) to: String,
}

/// Where parameters come from.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) enum ParameterSource {
    File(PathBuf),
    /// Name and value, this as YAML.
    Given(String, String),
}

impl RosArguments {
    /// Takes what stands between `--ros-args` and `--` (or the end) out of the arguments of a program. What is left
    /// are the program's own.
    pub(crate) fn split(arguments: impl IntoIterator<Item = String>) -> Result<(Vec<String>, Self)> {
        let (mut own, mut ros) = (Vec::new(), Self::default());
        let mut arguments = arguments.into_iter();
        let mut is_ros = false;
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--ros-args" => is_ros = true,
                "--" if is_ros => is_ros = false,
                _ if is_ros => ros.take(&argument, &mut arguments)?,
                _ => own.push(argument),
            }
        }
        Ok((own, ros))
    }

    fn take(&mut self, flag: &str, rest: &mut impl Iterator<Item = String>) -> Result<()> {
        let mut value = || rest.next().with_context(|| format!("--ros-args {flag} stands without its value"));
        match flag {
            "-r" | "--remap" => self.remap(&value()?),
            "-p" | "--param" => {
                let rule = value()?;
                let (name, value) = parted(&rule, "-p NAME:=VALUE")?;
                // A parameter may be for one node alone; there is one here.
                let name = name.rsplit_once(':').map_or(name, |(_, name)| name);
                self.parameters.push(ParameterSource::Given(name.into(), value.into()));
                Ok(())
            }
            "--params-file" => {
                self.parameters.push(ParameterSource::File(value()?.into()));
                Ok(())
            }
            "-e" | "--enclave" | "--log-level" | "--log-config-file" | "--log-file-name" => {
                let value = value()?;
                self.ignored.push(format!("{flag} {value}"));
                Ok(())
            }
            _ if flag.ends_with("-rosout-logs")
                || flag.ends_with("-stdout-logs")
                || flag.ends_with("-external-lib-logs") =>
            {
                self.ignored.push(flag.into());
                Ok(())
            }
            _ => bail!(
                "`{flag}` is none of the arguments that may stand behind --ros-args (-r, -p, --params-file)"
            ),
        }
    }

    fn remap(&mut self, rule: &str) -> Result<()> {
        let (from, to) = parted(rule, "-r FROM:=TO")?;
        let (node, from) = match from.split_once(':') {
            Some((node, from)) if !from.starts_with("//") => (Some(node.to_owned()), from),
            _ => (None, from),
        };
        match from {
            "__ns" => self.namespace = Some(to.into()),
            "__node" | "__name" => self.node = Some(to.into()),
            _ => self.remaps.push(Remap { node, from: from.into(), to: to.into() }),
        }
        Ok(())
    }
}

fn parted<'a>(rule: &'a str, expected: &str) -> Result<(&'a str, &'a str)> {
    match rule.split_once(":=") {
        Some((from, to)) if !from.is_empty() && !to.is_empty() => Ok((from, to)),
        _ => bail!("`{rule}` is no rule, expected {expected}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn split(text: &str) -> Result<(Vec<String>, RosArguments)> {
        RosArguments::split(text.split(' ').map(str::to_owned))
    }

    #[test]
    fn arguments_of_ros_stand_between_its_own_and_two_dashes() {
        let (own, ros) = split(
            "--config a.toml --ros-args -r __ns:=/robot1 -r points:=/lidar -r flockmap:tf:=tf2 --params-file p.yaml \
             -p map.range_m:=5.0 --log-level info --disable-rosout-logs -- --verbose",
        )
        .unwrap();
        assert_eq!(own, ["--config", "a.toml", "--verbose"]);
        assert_eq!(ros.namespace.as_deref(), Some("/robot1"));
        let remap = |node: Option<&str>, from: &str, to: &str| Remap {
            node: node.map(str::to_owned),
            from: from.into(),
            to: to.into(),
        };
        assert_eq!(ros.remaps, [remap(None, "points", "/lidar"), remap(Some("flockmap"), "tf", "tf2")]);
        let given = ParameterSource::Given("map.range_m".into(), "5.0".into());
        assert_eq!(ros.parameters, [ParameterSource::File("p.yaml".into()), given]);
        assert_eq!(ros.ignored, ["--log-level info", "--disable-rosout-logs"]);
    }

    #[test]
    fn what_is_no_argument_of_ros_is_an_error_that_names_it() {
        for (text, part) in [
            ("--ros-args --config a", "`--config` is none"),
            ("--ros-args -r", "-r stands without its value"),
            ("--ros-args -r points", "`points` is no rule, expected -r FROM:=TO"),
            ("--ros-args -p a:=", "`a:=` is no rule"),
        ] {
            let error = split(text).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
