//! The token of the view: where it comes from.

use flockmap_view::Token;

use super::NodeConfig;
use super::convert::value;
use super::error::ConfigError;
use super::parse::read_text;

/// A file with more than this is no token.
const FILE_BYTES_MAX: u64 = 4_096;

impl NodeConfig {
    /// The token of `[view]`, from the configuration or from a file; `None` if neither has one.
    ///
    /// # Errors
    /// A file that cannot be read, or a text that is no token. It is not in the error's text.
    pub fn view_token(&self) -> Result<Option<Token>, ConfigError> {
        let expected = "16 to 128 letters, digits, - and _";
        if let Some(secret) = &self.view.token {
            let fail = |_| value("[view] token", "a text that is none", expected);
            return Token::new(secret.text()).map(Some).map_err(fail);
        }
        let Some(path) = &self.view.token_file else { return Ok(None) };
        let name = "[view] token_file";
        let fail =
            |got: String, expected: &str| value(name, format!("\"{}\"{got}", path.display()), expected);
        let text = read_text(path, FILE_BYTES_MAX)
            .map_err(|error| fail(format!(" ({error})"), "a file that can be read"))?
            .ok_or_else(|| fail(String::new(), "a file with nothing but the token"))?;
        let token = Token::new(text.trim());
        token.map(Some).map_err(|_| fail(String::new(), &format!("a file with nothing but {expected}")))
    }
}
