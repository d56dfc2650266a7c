//! The node of ROS with its topics: what they are called, and how they are sent.

use std::net::{IpAddr, UdpSocket};

use anyhow::{Context as _, Result, anyhow};
use flockmap_io::ros::RosMessage;
use flockmap_node::RosSection;
use ros2_client::dds::rustdds::{
    DomainParticipant, DomainParticipantBuilder, DomainParticipantStatusListener,
};
use ros2_client::qos::{Durability, History, Reliability, WhenFull};
use ros2_client::ros2::QosProfile;
use ros2_client::{Context, MessageTypeName, Node, NodeOptions, Publisher, Subscription};
use serde::Serialize;

use crate::links::Links;
use crate::names::Names;

/// The environment variable that all programs of ROS 2 read.
const DOMAIN_VARIABLE: &str = "ROS_DOMAIN_ID";

/// Sensor data: what is late is of no use (REP-2003).
pub(crate) const SENSOR: QosProfile =
    QosProfile::subscription_default().history(History::KeepLast { depth: 5 });
/// The same for clouds of several MB, of which some part is lost each time.
pub(crate) const SENSOR_RELIABLE: QosProfile = SENSOR.reliability(RELIABLE);
/// The same for small messages that come often.
pub(crate) const POSES: QosProfile = SENSOR.history(History::KeepLast { depth: 100 });
/// `/clock`.
pub(crate) const CLOCK: QosProfile = SENSOR.history(History::KeepLast { depth: 1 });
/// `/tf`
pub(crate) const TF: QosProfile = POSES.reliability(RELIABLE);
/// `/tf_static`
pub(crate) const TF_STATIC: QosProfile = TF.durability(Durability::TransientLocal);
/// Maps: reliable, and whoever comes late gets the last one (REP-2003).
pub(crate) const MAP: QosProfile = CLOCK.reliability(RELIABLE).durability(Durability::TransientLocal);
/// What is said again and again.
pub(crate) const STATUS: QosProfile = SENSOR.reliability(RELIABLE);

const RELIABLE: Reliability = Reliability::Reliable { when_full: WhenFull::DEFAULT };

/// The node of ROS.
pub(crate) struct Topics {
    names: Names,
    node: Node,
    participant: DomainParticipant,
    links: Links,
}

impl Topics {
    /// Joins the domain, on the interfaces of the configuration alone.
    pub(crate) fn open(section: &RosSection, names: Names) -> Result<Self> {
        let domain = match (section.domain_id, std::env::var(DOMAIN_VARIABLE)) {
            (Some(domain), _) => domain,
            (None, Ok(text)) if !text.is_empty() => text
                .parse()
                .with_context(|| format!("{DOMAIN_VARIABLE} is `{text}`, expected a number, 0 to 232"))?,
            _ => 0,
        };
        let interfaces = section.interfaces.iter().map(|text| interface(text)).collect::<Result<Vec<_>>>()?;
        let participant = DomainParticipantBuilder::new(domain)
            .with_only_networks(interfaces)
            .build()
            .map_err(|error| anyhow!("cannot join DDS domain {domain}: {error:?}"))?;
        let context = Context::from_domain_participant(participant.clone())
            .map_err(|error| anyhow!("cannot join DDS domain {domain}: {error:?}"))?;
        // Its parameters are read once, from files and arguments.
        let options = NodeOptions::new().enable_rosout(false).start_parameter_services(false);
        let node = context
            .new_node(names.node_name()?, options)
            .map_err(|error| anyhow!("cannot make the node {}: {error:?}", names.node_path()))?;
        Ok(Self { names, node, participant, links: Links::default() })
    }

    pub(crate) const fn names(&self) -> &Names {
        &self.names
    }

    pub(crate) fn subscribe<M: RosMessage + 'static>(
        &mut self,
        name: &str,
        qos: QosProfile,
    ) -> Result<Subscription<M>> {
        let topic = self.topic::<M>(name, &qos)?;
        let made: Result<Subscription<M>, _> = self.node.create_subscription(&topic, Some(qos));
        let full = self.names.topic(name);
        let made = made.map_err(|error| anyhow!("cannot subscribe to {full}: {error:?}"))?;
        self.links.add(made.guid(), full);
        Ok(made)
    }

    pub(crate) fn publish<M: RosMessage + Serialize>(
        &mut self,
        name: &str,
        qos: QosProfile,
    ) -> Result<Publisher<M>> {
        let topic = self.topic::<M>(name, &qos)?;
        let made: Result<Publisher<M>, _> = self.node.create_publisher(&topic, Some(qos));
        let full = self.names.topic(name);
        let made = made.map_err(|error| anyhow!("cannot publish {full}: {error:?}"))?;
        self.links.add(made.guid(), full);
        Ok(made)
    }

    fn topic<M: RosMessage>(&self, name: &str, qos: &QosProfile) -> Result<ros2_client::dds::rustdds::Topic> {
        let full = self.names.ros_name(name)?;
        let made = self.node.create_topic(&full, MessageTypeName::new(M::PACKAGE, M::NAME), qos);
        made.map_err(|error| anyhow!("cannot make the topic {}: {error:?}", self.names.topic(name)))
    }

    /// Who is on the other side of the topics.
    pub(crate) fn links(&self) -> Links {
        self.links.clone()
    }

    /// What discovery says, to be read by one reader.
    pub(crate) fn discovery(&self) -> DomainParticipantStatusListener {
        self.participant.status_listener()
    }
}

/// The address of an interface of this machine. DDS would go on with none, and hear nothing.
fn interface(text: &str) -> Result<IpAddr> {
    let expected = "expected the IP address of an interface, such as \"127.0.0.1\"";
    let address: IpAddr = text.parse().map_err(|_| anyhow!("[ros] interfaces has \"{text}\", {expected}"))?;
    UdpSocket::bind((address, 0)).map_err(|error| {
        anyhow!("[ros] interfaces has \"{text}\", which no interface here has ({error}): {expected}")
    })?;
    Ok(address)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interface_must_be_there() {
        assert_eq!(interface("127.0.0.1").unwrap(), IpAddr::from([127, 0, 0, 1]));
        for (text, part) in
            [("eth0", "\"eth0\", expected the IP address"), ("203.0.113.5", "no interface here has")]
        {
            let error = interface(text).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
