//! The key that a swarm shares.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use std::fmt;
use std::str::FromStr;

/// The secret that all robots of a swarm share: 32 bytes, best drawn by `flockmap key` or `openssl rand -hex
/// 32`. Who has it is trusted in everything; who has not can neither read what is sent nor send what is
/// believed. `docs/key.md` says what that covers and what it does not.
///
/// Use a key for nothing but this protocol, and not for two swarms whose robots have ids in common. It is
/// never printed.
///
/// ```
/// let key: flockmap_sync::SwarmKey = "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff".parse()?;
/// assert_eq!(format!("{key:?}"), "SwarmKey(32 bytes)");
/// # Ok::<(), flockmap_sync::KeyError>(())
/// ```
#[derive(Clone, PartialEq, Eq)]
pub struct SwarmKey([u8; Self::BYTES]);

impl SwarmKey {
    /// Length of a key.
    pub const BYTES: usize = 32;

    /// A key of these bytes. Bytes that a person made up are guessed; let a random generator make them.
    pub const fn from_bytes(bytes: [u8; Self::BYTES]) -> Self {
        Self(bytes)
    }

    pub(crate) const fn bytes(&self) -> &[u8; Self::BYTES] {
        &self.0
    }
}

impl fmt::Debug for SwarmKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SwarmKey({} bytes)", Self::BYTES)
    }
}

/// A text that is no key. It does not say the text, which may be a secret with one letter wrong.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum KeyError {
    /// Not in one of the two forms.
    #[error(
        "a text of {got} characters, expected 64 hex digits or the 44 of base64: `flockmap key` makes one"
    )]
    Form {
        /// Characters of the text, without white space around it.
        got: usize,
    },
    /// All bytes are the same: a place that was left to be filled in.
    #[error("one byte repeated 32 times, expected a random key: `flockmap key` makes one")]
    Blank,
}

impl FromStr for SwarmKey {
    type Err = KeyError;

    /// Takes 64 hex digits, or base64 (with padding) of 32 bytes; white space around them is left out.
    fn from_str(text: &str) -> Result<Self, KeyError> {
        let text = text.trim();
        let bytes = from_hex(text).or_else(|| STANDARD.decode(text).ok()?.try_into().ok());
        let bytes: [u8; Self::BYTES] = bytes.ok_or_else(|| KeyError::Form { got: text.chars().count() })?;
        if bytes.iter().all(|&byte| byte == bytes[0]) {
            return Err(KeyError::Blank);
        }
        Ok(Self(bytes))
    }
}

fn from_hex(text: &str) -> Option<[u8; SwarmKey::BYTES]> {
    let mut bytes = [0; SwarmKey::BYTES];
    if text.len() != 2 * bytes.len() {
        return None;
    }
    for (byte, digits) in bytes.iter_mut().zip(text.as_bytes().chunks_exact(2)) {
        let digit = |digit: u8| char::from(digit).to_digit(16);
        *byte = (digit(digits[0])? << 4 | digit(digits[1])?) as u8;
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEX: &str = "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f";

    #[test]
    fn a_key_is_read_from_hex_and_from_base64() {
        let key: SwarmKey = HEX.parse().unwrap();
        assert_eq!(*key.bytes(), core::array::from_fn(|i| i as u8));
        assert_eq!(format!(" {}\n", HEX.to_uppercase()).parse(), Ok(key.clone()));
        assert_eq!("AAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8=".parse(), Ok(key));
    }

    #[test]
    fn what_is_no_key_is_refused_without_saying_it() {
        for text in
            ["", "secret", &HEX[1..], &HEX.replace('f', "g"), "AAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxw="]
        {
            let error = text.parse::<SwarmKey>().unwrap_err();
            assert_eq!(error, KeyError::Form { got: text.len() });
            assert!(text.is_empty() || !error.to_string().contains(text));
        }
        assert_eq!("é".repeat(32).parse::<SwarmKey>(), Err(KeyError::Form { got: 32 }));
        assert_eq!("00".repeat(32).parse::<SwarmKey>(), Err(KeyError::Blank));
    }

    #[test]
    fn a_key_is_never_printed() {
        let config = crate::SessionConfig {
            swarm_key: Some(HEX.parse().unwrap()),
            salt: [1; 16],
            ..Default::default()
        };
        let own = flockmap_grid::Stream { origin: flockmap_grid::RobotId(1), epoch: 1 };
        let session = crate::Session::new(own, config, 1).unwrap();
        let printed = format!("{session:?}");
        assert!(printed.contains("swarm_key: Some(SwarmKey(32 bytes))"));
        assert!(!printed.contains("14, 15, 16") && !printed.contains("0e0f10"));
    }
}
