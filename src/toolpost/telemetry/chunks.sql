-- schema --
CREATE TABLE IF NOT EXISTS shape (
    id INTEGER PRIMARY KEY,
    definition BLOB NOT NULL,  -- MessagePack: machine, tag, keys, kinds
    sealed INTEGER NOT NULL    -- rows that are or were in chunks
);
-- The index of chunks is apart from their bytes, so that a start reads kilobytes, not the file.
CREATE TABLE IF NOT EXISTS chunk (
    id INTEGER PRIMARY KEY,    -- ascending in the order of arrival
    shape INTEGER NOT NULL,
    epoch INTEGER NOT NULL,
    first_us INTEGER NOT NULL,
    last_us INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS body (
    id INTEGER PRIMARY KEY,    -- chunk.id
    data BLOB NOT NULL         -- columns.pack()
);
-- shapes --
SELECT id, definition, sealed FROM shape ORDER BY id;
-- chunks --
SELECT id, shape, epoch, first_us, last_us FROM chunk ORDER BY id;
-- put_shape --
INSERT INTO shape (id, definition, sealed) VALUES (?1, ?2, ?3)
ON CONFLICT (id) DO UPDATE SET definition = ?2, sealed = ?3;
-- drop_shape --
DELETE FROM shape WHERE id = ?;
-- put_chunk --
INSERT INTO chunk (id, shape, epoch, first_us, last_us) VALUES (?, ?, ?, ?, ?);
-- put_body --
INSERT INTO body (id, data) VALUES (?, ?);
-- oldest --
SELECT id, shape FROM chunk ORDER BY id LIMIT ?;
-- aged --
SELECT id, shape FROM chunk WHERE last_us < ? ORDER BY id;
-- drop_chunk --
DELETE FROM chunk WHERE id = ?;
-- drop_body --
DELETE FROM body WHERE id = ?;
