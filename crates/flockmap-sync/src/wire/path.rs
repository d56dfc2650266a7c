//! PATH datagrams: whether a robot is to be reached at an address, asked and answered.

use super::datagram::{Datagram, DatagramError, DatagramHeader, Kind, put_record, seal};
use flockmap_codec::bytes::Reader;

const CHALLENGE: u8 = 32;
const ANSWER: u8 = 33;

/// What a PATH datagram says.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct PathMessage {
    /// A number that goes to one address: who sends it back is there.
    pub challenge: Option<u64>,
    /// The number of a challenge that was received.
    pub answer: Option<u64>,
}

impl PathMessage {
    /// Reads the records; unknown ones are skipped.
    pub fn parse(datagram: &Datagram<'_>) -> Result<Self, DatagramError> {
        let mut message = Self::default();
        for (id, content) in datagram.records() {
            let field = match id {
                CHALLENGE => &mut message.challenge,
                ANSWER => &mut message.answer,
                _ => continue,
            };
            let mut reader = Reader::new(content);
            let number = reader.u64().filter(|_| reader.is_empty());
            *field = Some(number.ok_or_else(|| datagram.malformed("number of a challenge"))?);
        }
        Ok(message)
    }

    /// The complete datagram.
    pub fn emit(&self, header: DatagramHeader) -> Vec<u8> {
        let mut out = DatagramHeader { kind: Kind::Path, ..header }.emit();
        for (id, number) in [(CHALLENGE, self.challenge), (ANSWER, self.answer)] {
            if let Some(number) = number {
                put_record(&mut out, id, &number.to_le_bytes());
            }
        }
        seal(out)
    }
}
