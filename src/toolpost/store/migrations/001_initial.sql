-- Jobs are never updated out of order: one writer, one statement per transition.
CREATE TABLE job (
    seq         INTEGER PRIMARY KEY AUTOINCREMENT,
    id          TEXT NOT NULL UNIQUE,
    machine     TEXT NOT NULL,
    program     TEXT NOT NULL,
    commands    INTEGER NOT NULL,
    name        TEXT NOT NULL,
    position    INTEGER NOT NULL,
    called      INTEGER NOT NULL,
    signals     TEXT NOT NULL,
    state       TEXT NOT NULL,
    reason      TEXT NOT NULL,
    detail      TEXT NOT NULL,
    actor       TEXT NOT NULL,
    created_us  INTEGER NOT NULL,
    started_us  INTEGER,
    ended_us    INTEGER
);
CREATE INDEX job_by_machine ON job (machine, seq);
CREATE INDEX job_by_program ON job (program);

CREATE TABLE job_event (
    seq         INTEGER PRIMARY KEY AUTOINCREMENT,
    job         INTEGER NOT NULL REFERENCES job (seq) ON DELETE CASCADE,
    time_us     INTEGER NOT NULL,
    actor       TEXT NOT NULL,
    state       TEXT NOT NULL,
    reason      TEXT NOT NULL,
    detail      TEXT NOT NULL
);
CREATE INDEX job_event_by_job ON job_event (job);

CREATE TABLE machine_setting (
    machine     TEXT NOT NULL,
    name        TEXT NOT NULL,
    value       TEXT NOT NULL,
    PRIMARY KEY (machine, name)
) WITHOUT ROWID;

CREATE TABLE api_key (
    name        TEXT PRIMARY KEY,
    sha256      BLOB NOT NULL UNIQUE,
    created_us  INTEGER NOT NULL
) WITHOUT ROWID;

CREATE TABLE namespace_item (
    seq         INTEGER PRIMARY KEY,
    namespace   TEXT NOT NULL,
    key         TEXT NOT NULL,
    size        INTEGER NOT NULL,
    value       BLOB NOT NULL,
    UNIQUE (namespace, key)
);
-- The bounds are checked on the index alone, without a look at the values.
CREATE INDEX namespace_item_by_size ON namespace_item (namespace, size);
