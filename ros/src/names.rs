//! Names of topics: from what a program calls them to what they are called on the wire.

use anyhow::{Context, Result};
use ros2_client::{Name, NodeName};

use crate::arguments::{Remap, RosArguments};

/// How the node is called.
const NODE: &str = "flockmap";

/// The name of the node, and what makes full names of those of its topics.
#[derive(Clone, Debug)]
pub(crate) struct Names {
    /// Empty, or with a slash in front and none behind.
    namespace: String,
    node: String,
    remaps: Vec<Remap>,
}

impl Names {
    pub(crate) fn new(arguments: &RosArguments) -> Result<Self> {
        let namespace = arguments.namespace.as_deref().unwrap_or_default().trim_matches('/');
        let namespace = if namespace.is_empty() { String::new() } else { format!("/{namespace}") };
        let node = arguments.node.clone().unwrap_or_else(|| NODE.into());
        let names = Self { namespace, node, remaps: arguments.remaps.clone() };
        names.node_name()?;
        Ok(names)
    }

    pub(crate) fn node_name(&self) -> Result<NodeName> {
        let namespace = if self.namespace.is_empty() { "/" } else { &self.namespace };
        NodeName::new(namespace, &self.node)
            .map_err(|error| anyhow::anyhow!("no node can be called `{}`: {error:?}", self.node_path()))
    }

    /// `/namespace/node`
    pub(crate) fn node_path(&self) -> String {
        format!("{}/{}", self.namespace, self.node)
    }

    /// The full name of a topic: remapped, with a slash in front.
    pub(crate) fn topic(&self, name: &str) -> String {
        let full = self.expanded(name);
        let is_meant = |rule: &&Remap| {
            rule.node.as_ref().is_none_or(|node| *node == self.node) && self.expanded(&rule.from) == full
        };
        self.remaps.iter().find(is_meant).map_or(full, |rule| self.expanded(&rule.to))
    }

    /// The same as the name that `ros2_client` takes.
    pub(crate) fn ros_name(&self, name: &str) -> Result<Name> {
        let full = self.topic(name);
        Name::parse(&full).map_err(|error| anyhow::anyhow!("{error:?}")).with_context(|| {
            format!("`{full}` is no name of a topic: letters, digits and _ between slashes, no digit first")
        })
    }

    fn expanded(&self, name: &str) -> String {
        match name.strip_prefix('~') {
            Some(rest) => format!("{}{rest}", self.node_path()),
            None if name.starts_with('/') => name.to_owned(),
            None => format!("{}/{name}", self.namespace),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(arguments: &str) -> Names {
        let arguments = format!("--ros-args {arguments}");
        let (_, ros) = RosArguments::split(arguments.split(' ').map(str::to_owned)).unwrap();
        Names::new(&ros).unwrap()
    }

    #[test]
    fn names_are_expanded_and_then_remapped_as_ros_does_it() {
        let plain = names("-r __node:=flockmap");
        assert_eq!(plain.topic("points"), "/points");
        assert_eq!(plain.topic("~/grid"), "/flockmap/grid");
        assert_eq!(plain.topic("/tf"), "/tf");
        let robot = names(
            "-r __ns:=/robot1 -r points:=velodyne/points -r /tf:=tf -r ~/grid:=/map -r other:odom:=x -r odom:=~/odom",
        );
        assert_eq!(robot.topic("points"), "/robot1/velodyne/points");
        assert_eq!(robot.topic("/tf"), "/robot1/tf");
        assert_eq!(robot.topic("~/grid"), "/map");
        assert_eq!(robot.topic("~/octomap_binary"), "/robot1/flockmap/octomap_binary");
        assert_eq!(robot.topic("odom"), "/robot1/flockmap/odom");
        assert_eq!(robot.node_path(), "/robot1/flockmap");
    }

    #[test]
    fn a_name_that_is_none_is_an_error() {
        assert!(names("-r points:=/a//b").ros_name("points").is_err());
        assert!(names("-r points:=/1a").ros_name("points").is_err());
        let (_, ros) = RosArguments::split(["--ros-args", "-r", "__node:=a-b"].map(str::to_owned)).unwrap();
        assert!(Names::new(&ros).unwrap_err().to_string().contains("`/a-b`"));
    }
}
