//! Who may read: checks of where a request comes from.
//!
//! A page of any web site that somebody opens on this machine can send requests to its loopback. Two headers that
//! browsers set and pages cannot tell them apart: `Origin`, which must be this server, and `Host`, which must be a
//! name of the loopback, since a hostile name server can let any other name mean 127.0.0.1 (DNS rebinding). Beyond
//! the loopback there is a token.

use std::net::IpAddr;
use std::sync::Arc;

use axum::http::header::{AUTHORIZATION, HOST, ORIGIN};
use axum::http::{HeaderMap, StatusCode};

/// What a reader beyond the loopback must say.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(Arc<str>);

/// Why a text is no token.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("a token has 16 to 128 letters, digits, - and _, and this has {0} characters or others among them")]
pub struct TokenError(usize);

/// Digits and letters of a token that is drawn: 24 of 32, which are 120 bits.
const DRAWN: (usize, &[u8; 32]) = (24, b"abcdefghijkmnopqrstuvwxyz2345678");

impl Token {
    /// Takes a text for a token.
    ///
    /// # Errors
    /// If it has fewer than 16 or more than 128 characters, or others than letters, digits, - and _.
    pub fn new(text: &str) -> Result<Self, TokenError> {
        let is_sound = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        let is_token = (16..=128).contains(&text.len()) && text.chars().all(is_sound);
        if is_token { Ok(Self(text.into())) } else { Err(TokenError(text.chars().count())) }
    }

    /// One that nobody can guess.
    ///
    /// # Errors
    /// If the system gives no random bytes.
    pub fn draw() -> std::io::Result<Self> {
        let mut bytes = [0; DRAWN.0];
        getrandom::fill(&mut bytes).map_err(std::io::Error::other)?;
        let letters = bytes.iter().map(|byte| char::from(DRAWN.1[usize::from(byte % 32)]));
        Ok(Self(letters.collect::<String>().into()))
    }

    /// The token as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Takes as long for every text of the same length.
    fn is(&self, said: &str) -> bool {
        let differ = self.0.bytes().zip(said.bytes()).fold(0, |all, (own, said)| all | (own ^ said));
        self.0.len() == said.len() && differ == 0
    }
}

impl core::fmt::Debug for Token {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Token(…)")
    }
}

/// Who may read.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Access {
    /// Who reaches the server by a name of the loopback, but for pages of other origins.
    Loopback,
    /// Who knows the token, but for pages of other origins.
    Token(Token),
    /// Everybody, as far as they are no page of another origin. For counters.
    Everybody,
}

/// Why a request is refused.
pub(crate) type Refusal = (StatusCode, &'static str);

impl Access {
    /// Whether the page itself may be loaded: it holds no map.
    pub(crate) fn check_page(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        let host = headers.get(HOST).and_then(|host| host.to_str().ok());
        if *self == Self::Loopback && !host.is_some_and(is_loopback) {
            return Err((StatusCode::FORBIDDEN, "open it as http://127.0.0.1 or http://localhost"));
        }
        let Some(origin) = headers.get(ORIGIN) else { return Ok(()) };
        let origin = origin.to_str().ok().and_then(|origin| origin.split_once("://"));
        match (origin, host) {
            (Some((_, origin)), Some(host)) if origin.eq_ignore_ascii_case(host) => Ok(()),
            _ => Err((StatusCode::FORBIDDEN, "a page of another origin may not read maps")),
        }
    }

    /// Whether a map, or counters, may be read.
    pub(crate) fn check(&self, headers: &HeaderMap, query: Option<&str>) -> Result<(), Refusal> {
        self.check_page(headers)?;
        let Self::Token(token) = self else { return Ok(()) };
        let bearer =
            headers.get(AUTHORIZATION).and_then(|value| value.to_str().ok()?.strip_prefix("Bearer "));
        let mut parts = query.unwrap_or_default().split('&');
        let said = bearer.or_else(|| parts.find_map(|part| part.strip_prefix("token=")));
        match said {
            Some(said) if token.is(said) => Ok(()),
            _ => Err((
                StatusCode::UNAUTHORIZED,
                "the token is missing or wrong: use the address that the node says in its log",
            )),
        }
    }
}

/// Whether a host with or without port names the loopback.
fn is_loopback(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if !port.is_empty() && port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    };
    let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    name.eq_ignore_ascii_case("localhost") || bare.parse().is_ok_and(|ip: IpAddr| ip.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(of: &[(axum::http::HeaderName, &str)]) -> HeaderMap {
        of.iter().map(|(name, value)| (name.clone(), value.parse().unwrap())).collect()
    }

    #[test]
    fn only_names_of_the_loopback_are_served_there() {
        for host in ["127.0.0.1:7781", "localhost:1", "LocalHost", "[::1]:7781", "127.9.9.9"] {
            assert_eq!(Access::Loopback.check(&headers(&[(HOST, host)]), None), Ok(()), "{host}");
        }
        for host in
            ["evil.example:7781", "127.0.0.1.evil.example", "192.168.1.2:7781", "", ":80", "[::1", "::1:x"]
        {
            let refused = Access::Loopback.check(&headers(&[(HOST, host)]), None);
            assert_eq!(refused.unwrap_err().0, StatusCode::FORBIDDEN, "{host}");
        }
        assert!(Access::Loopback.check(&HeaderMap::new(), None).is_err());
    }

    #[test]
    fn pages_of_other_origins_are_refused_everywhere() {
        let token = Token::draw().unwrap();
        let query = format!("token={}", token.as_str());
        for access in [Access::Loopback, Access::Token(token), Access::Everybody] {
            let with = |origin: &str| {
                let headers = headers(&[(HOST, "127.0.0.1:7781"), (ORIGIN, origin)]);
                access.check(&headers, Some(&query)).is_ok()
            };
            assert!(with("http://127.0.0.1:7781") && with("https://127.0.0.1:7781"));
            for origin in [
                "http://127.0.0.1:7782",
                "http://evil.example",
                "null",
                "http://localhost:7781",
                "file://",
                "",
            ] {
                assert!(!with(origin), "{origin} at {access:?}");
            }
        }
    }

    #[test]
    fn beyond_the_loopback_the_token_is_needed() {
        let token = Token::draw().unwrap();
        let (text, access) = (token.as_str().to_owned(), Access::Token(token));
        let host = [(HOST, "robot1.local:7781")];
        let query = |text: &str| access.check(&headers(&host), Some(text)).is_ok();
        assert!(query(&format!("token={text}")) && query(&format!("a=b&token={text}")));
        assert!(!query("") && !query("token=") && !query(&format!("token={text}x")) && !query(&text));
        assert!(!query(&format!("token={}", &text[1..])));
        let bearer = format!("Bearer {text}");
        assert_eq!(access.check(&headers(&[host[0].clone(), (AUTHORIZATION, &bearer)]), None), Ok(()));
        assert_eq!(access.check(&headers(&host), None).unwrap_err().0, StatusCode::UNAUTHORIZED);
        assert_eq!(access.check_page(&headers(&host)), Ok(()));
    }

    #[test]
    fn tokens_are_drawn_and_taken_but_short_ones_are_not() {
        let drawn = Token::draw().unwrap();
        assert_eq!(Token::new(drawn.as_str()), Ok(drawn.clone()));
        assert_ne!(Token::draw().unwrap(), drawn);
        assert_eq!(Token::new("short"), Err(TokenError(5)));
        assert!(Token::new(&"a b".repeat(9)).is_err() && Token::new(&"a".repeat(129)).is_err());
        assert_eq!(format!("{drawn:?}"), "Token(…)");
    }
}
