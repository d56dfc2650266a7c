//! What a node is towards Zenoh: it puts, takes, answers and catches up, each on a thread of its own.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Result, anyhow};
use flockmap::codec::Encoder;
use flockmap_node::{ConfiguredNode, Log};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Locality, SampleKind};
use zenoh::{Session, Wait};

use crate::answers::{Answers, Kept, WAITING_MAX};
use crate::catch_up::{CatchUp, Holders};
use crate::counters::Counters;
use crate::keys::{Keys, parse_holder};
use crate::puts::{Noted, Put, put_all};
use crate::takes::{By, Intake};

/// What a node does beyond its radio.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Roles {
    /// It puts what it merges and makes.
    pub(crate) puts: bool,
    /// It takes what others put, and asks for what it lacks.
    pub(crate) takes: bool,
    /// It answers, to holders that ask for what they lack.
    pub(crate) answers: bool,
    /// It answers to everybody, under the keys of packages.
    pub(crate) answers_everybody: bool,
    /// It has a radio, and measures the clocks of robots.
    pub(crate) on_radio: bool,
}

/// Who a node is towards Zenoh.
#[derive(Clone)]
pub(crate) struct Identity {
    pub(crate) session: Session,
    pub(crate) keys: Keys,
    /// Of the holder.
    pub(crate) name: String,
    pub(crate) roles: Roles,
    /// How often it looks what others hold.
    pub(crate) period: Duration,
}

/// What was made before the node, for it to be observed.
pub(crate) struct Watched {
    pub(crate) puts: Receiver<Put>,
    pub(crate) noted: Noted,
    pub(crate) counters: Counters,
}

/// The threads of a node, and what they have declared.
pub(crate) struct Face {
    threads: Vec<JoinHandle<()>>,
    tokens: Option<Subscriber<()>>,
    subscriber: Option<Subscriber<()>>,
    queryables: Vec<Queryable<()>>,
    token: Option<LivelinessToken>,
    /// Wakes the one that catches up, and keeps it there.
    wake: Option<SyncSender<()>>,
}

impl Face {
    /// Starts them.
    pub(crate) fn start(
        identity: Identity,
        node: &Arc<ConfiguredNode>,
        watched: Watched,
        log: &Log,
    ) -> Result<Self> {
        let Identity { session, keys, name, roles, period } = identity;
        let Watched { puts, noted, counters } = watched;
        let mut face = Self {
            threads: Vec::new(),
            tokens: None,
            subscriber: None,
            queryables: Vec::new(),
            token: None,
            wake: None,
        };
        if roles.puts {
            let (session, counters) = (session.clone(), counters.clone());
            face.thread("put", move || put_all(&session, keys, &puts, &counters))?;
        }
        if roles.takes {
            face.take(&session, (keys, &name, roles, period), node, (noted, &counters), log)?;
        }
        if roles.answers {
            let (queries, queries_in) = sync_channel(WAITING_MAX);
            {
                let (node, name, counters) = (Arc::clone(node), name.clone(), counters.clone());
                face.thread("answers", move || {
                    let answers = Answers {
                        keys,
                        name: &name,
                        on_radio: roles.on_radio,
                        node: &node.node,
                        counters: &counters,
                        encoder: Encoder::new(),
                        kept: Kept::default(),
                    };
                    answers.answer_all(&queries_in);
                })?;
            }
            let mut places = vec![format!("{}/**", keys.holder(&name))];
            if roles.answers_everybody {
                places.push(keys.all());
            }
            for place in places {
                let (queries, refused) = (queries.clone(), counters.clone());
                let queryable =
                    session.declare_queryable(place).complete(true).callback(move |query: Query| {
                        if let Err(left) = queries.try_send(query) {
                            refused.queries_refused.add(1);
                            let query = match left {
                                std::sync::mpsc::TrySendError::Full(query)
                                | std::sync::mpsc::TrySendError::Disconnected(query) => query,
                            };
                            // Who asked may be gone.
                            let _ = query.reply_err("too many ask at once: ask again").wait();
                        }
                    });
                face.queryables.push(queryable.wait().map_err(|error| anyhow!("cannot answer: {error}"))?);
            }
            let token = session.liveliness().declare_token(keys.holder(&name)).wait();
            face.token = Some(token.map_err(|error| anyhow!("cannot be found by others: {error}"))?);
        }
        Ok(face)
    }

    fn take(
        &mut self,
        session: &Session,
        (keys, name, roles, period): (Keys, &str, Roles, Duration),
        node: &Arc<ConfiguredNode>,
        (noted, counters): (Noted, &Counters),
        log: &Log,
    ) -> Result<()> {
        let (intake, outlet) = Intake::new(keys, noted, counters.clone());
        {
            let node = Arc::clone(node);
            self.thread("take", move || outlet.give_all(&node.node))?;
        }
        let (wake, woken) = sync_channel(1);
        let holders = Holders::default();
        let (seen, waking) = (holders.clone(), wake.clone());
        let tokens = session.liveliness().declare_subscriber(keys.holder("*")).history(true);
        let tokens = tokens.callback(move |token| {
            let Some((_, _, name)) = parse_holder(token.key_expr().as_str()) else { return };
            if seen.set(name, token.kind() == SampleKind::Put) {
                // If it is being woken already, that will do.
                let _ = waking.try_send(());
            }
        });
        self.tokens = Some(tokens.wait().map_err(|error| anyhow!("cannot look for holders: {error}"))?);
        let put = intake.clone();
        // What this session puts itself is not for it.
        let subscriber = session.declare_subscriber(keys.all()).allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample| put.take(&sample, By::Put)).wait();
        self.subscriber = Some(subscriber.map_err(|error| anyhow!("cannot subscribe: {error}"))?);
        self.wake = Some(wake);
        let (session, name, node) = (session.clone(), name.to_owned(), Arc::clone(node));
        let (counters, log) = (counters.clone(), log.clone());
        self.thread("catch-up", move || {
            let catch_up = CatchUp {
                session: &session,
                keys,
                name: &name,
                on_radio: roles.on_radio,
                period,
                node: &node.node,
                intake: &intake,
                holders,
                counters: &counters,
                log: &log,
            };
            catch_up.run(&woken);
        })
    }

    fn thread(&mut self, name: &str, work: impl FnOnce() + Send + 'static) -> Result<()> {
        let thread = std::thread::Builder::new().name(name.into()).spawn(work);
        self.threads.push(thread.map_err(|error| anyhow!("cannot start a thread: {error}"))?);
        Ok(())
    }

    /// After the node has ended: puts what is left, and lets go of everything.
    pub(crate) fn end(self) {
        let Self { threads, tokens, subscriber, queryables, token, wake } = self;
        // Others stop asking before nobody answers any more.
        drop((token, tokens, wake, subscriber, queryables));
        for thread in threads {
            // What it was for is over.
            let _ = thread.join();
        }
    }
}
