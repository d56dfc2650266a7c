//! A question of somebody, and where its answers go.

use zenoh::Wait;
use zenoh::key_expr::KeyExpr;
use zenoh::query::{Query, ReplyKeyExpr};

/// What [`Answers`](crate::answers::Answers) needs of a query.
pub(crate) trait Question {
    /// What is asked for.
    fn key(&self) -> &KeyExpr<'_>;

    /// A parameter, by its name.
    fn parameter(&self, name: &str) -> Option<&str>;

    /// Whether answers may have other keys than what is asked for.
    fn takes_any_key(&self) -> bool;

    /// Answers. An error says that this question can be told nothing more.
    fn reply(&self, key: &str, value: Vec<u8>) -> Result<(), String>;

    /// Says that something cannot be told. Who asked may be gone.
    fn refuse(&self, why: &str);
}

impl Question for Query {
    fn key(&self) -> &KeyExpr<'_> {
        self.key_expr()
    }

    fn parameter(&self, name: &str) -> Option<&str> {
        self.parameters().get(name)
    }

    fn takes_any_key(&self) -> bool {
        self.accepts_replies() == ReplyKeyExpr::Any
    }

    fn reply(&self, key: &str, value: Vec<u8>) -> Result<(), String> {
        Self::reply(self, key, value).wait().map_err(|error| error.to_string())
    }

    fn refuse(&self, why: &str) {
        let _ = self.reply_err(why).wait();
    }
}
