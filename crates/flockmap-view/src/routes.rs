//! What each path answers.

use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::{FromRequestParts, Request, State, WebSocketUpgrade};
use axum::http::header::{
    ACCEPT_ENCODING, ALLOW, CACHE_CONTROL, CONNECTION, CONTENT_ENCODING, CONTENT_SECURITY_POLICY,
    CONTENT_TYPE, HeaderName, HeaderValue, REFERRER_POLICY, VARY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use serde_json::json;
use tokio::sync::{Semaphore, mpsc};

use crate::access::{Access, Refusal};
use crate::page::{FILES, File};
use crate::socket::{CONTROLS_WAITING_MAX, MESSAGE_BYTES_MAX, PIPE_BYTES, pump};
use crate::{Content, Series, Source};

/// Browsers that may follow maps at once, over all sources. Each source has limits of its own.
pub(crate) const SOCKETS_MAX: usize = 64;

/// The page takes nothing from elsewhere, and nobody may put it into a page of theirs.
const POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; \
                      frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

pub(crate) struct Served {
    content: Content,
    access: Access,
    sockets: Arc<Semaphore>,
}

/// `sockets` has a permit for each browser that may follow a map.
pub(crate) fn router(content: Content, access: Access, sockets: Arc<Semaphore>) -> Router {
    Router::new().fallback(answer).with_state(Arc::new(Served { content, access, sockets }))
}

async fn answer(State(served): State<Arc<Served>>, request: Request) -> Response {
    let is_head = request.method() == Method::HEAD;
    let mut response = served.respond(request).await.unwrap_or_else(|(status, text)| {
        (status, [(CONTENT_TYPE, "text/plain; charset=utf-8")], format!("{text}\n")).into_response()
    });
    let headers = response.headers_mut();
    let mut set = |name: HeaderName, value: &'static str| {
        headers.insert(name, HeaderValue::from_static(value));
    };
    set(CONTENT_SECURITY_POLICY, POLICY);
    set(X_CONTENT_TYPE_OPTIONS, "nosniff");
    set(REFERRER_POLICY, "no-referrer");
    set(CACHE_CONTROL, "no-store");
    set(HeaderName::from_static("cross-origin-resource-policy"), "same-origin");
    if response.status() != StatusCode::SWITCHING_PROTOCOLS {
        // One request each: an idle connection holds no place.
        response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    }
    if is_head {
        *response.body_mut() = Body::empty();
    }
    response
}

impl Served {
    async fn respond(&self, request: Request) -> Result<Response, Refusal> {
        let (mut parts, _) = request.into_parts();
        let has_page = !self.content.sources.is_empty();
        let path = parts.uri.path().to_owned();
        let page = FILES.iter().find(|file| has_page && file.path == path);
        match page {
            Some(_) => self.access.check_page(&parts.headers)?,
            None => self.access.check(&parts.headers, parts.uri.query())?,
        }
        if !matches!(parts.method, Method::GET | Method::HEAD) {
            let words = "this is only read: GET or HEAD";
            return Ok((StatusCode::METHOD_NOT_ALLOWED, [(ALLOW, "GET, HEAD")], words).into_response());
        }
        if let Some(file) = page {
            return Ok(file_response(file, &parts.headers));
        }
        match path.trim_matches('/').split_once('/') {
            None if path == "/metrics" => self.metrics().await,
            None if path == "/robots" && has_page => Ok(self.robots()),
            Some(("series", id)) => {
                let series = self.source(id)?.series();
                let nothing = || Arc::new(Series::new(Vec::new()));
                Ok(json_response(&series.unwrap_or_else(nothing).json()))
            }
            Some(("feed", id)) => {
                let source = Arc::clone(self.source(id)?);
                let upgrade = WebSocketUpgrade::from_request_parts(&mut parts, &()).await;
                let upgrade = upgrade
                    .map_err(|_| (StatusCode::UPGRADE_REQUIRED, "the feed is a WebSocket: docs/view.md"))?;
                self.feed(source, upgrade)
            }
            _ if has_page => Err((StatusCode::NOT_FOUND, "nothing is here; the page is at /")),
            _ => Err((StatusCode::NOT_FOUND, "the counters are at /metrics")),
        }
    }

    fn source(&self, id: &str) -> Result<&Arc<dyn Source>, Refusal> {
        let id = id.parse::<u16>().ok();
        let source = self.content.sources.iter().find(|source| Some(source.id()) == id);
        source.ok_or((StatusCode::NOT_FOUND, "no robot has this number; /robots lists them"))
    }

    fn feed(&self, source: Arc<dyn Source>, upgrade: WebSocketUpgrade) -> Result<Response, Refusal> {
        let full = (StatusCode::SERVICE_UNAVAILABLE, "too many browsers follow maps here; close one");
        let permit = Arc::clone(&self.sockets).try_acquire_owned().map_err(|_| full)?;
        let upgrade = upgrade.max_message_size(MESSAGE_BYTES_MAX).max_frame_size(MESSAGE_BYTES_MAX);
        Ok(upgrade.on_upgrade(move |socket| async move {
            let (ours, theirs) = tokio::io::duplex(PIPE_BYTES);
            let (controls, controls_in) = mpsc::channel(CONTROLS_WAITING_MAX);
            source.connect(theirs, controls_in);
            pump(socket, ours, controls).await;
            drop(permit);
        }))
    }

    async fn metrics(&self) -> Result<Response, Refusal> {
        let Some(metrics) = &self.content.metrics else {
            return Err((StatusCode::NOT_FOUND, "nothing is counted here"));
        };
        let text = metrics().await.ok_or((StatusCode::SERVICE_UNAVAILABLE, "the node is ending"))?;
        Ok(([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response())
    }

    fn robots(&self) -> Response {
        let robot = |source: &Arc<dyn Source>| json!({ "id": source.id(), "name": source.name() });
        let robots: Vec<_> = self.content.sources.iter().map(robot).collect();
        json_response(&json!({ "title": self.content.title, "kind": self.content.kind, "robots": robots }))
    }
}

fn json_response(value: &serde_json::Value) -> Response {
    ([(CONTENT_TYPE, "application/json")], value.to_string()).into_response()
}

fn file_response(file: &'static File, headers: &HeaderMap) -> Response {
    let encodings = headers.get(ACCEPT_ENCODING).and_then(|value| value.to_str().ok()).unwrap_or_default();
    let takes_gzip = encodings.split(',').any(|word| word.split(';').next().map(str::trim) == Some("gzip"));
    let head = [(CONTENT_TYPE, file.mime), (VARY, "accept-encoding")];
    match takes_gzip {
        true => (head, [(CONTENT_ENCODING, "gzip")], file.packed()).into_response(),
        false => (head, file.bytes).into_response(),
    }
}
