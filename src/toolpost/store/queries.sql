-- name: insert_job
INSERT INTO job (seq, id, machine, program, commands, name, position, called, signals, state, reason, detail,
                 actor, created_us, started_us, ended_us)
VALUES (:seq, :id, :machine, :program, :commands, :name, :position, :called, :signals, :state, :reason, :detail,
        :actor, :created_us, :started_us, :ended_us);

-- name: update_job
UPDATE job
SET position = :position, called = :called, state = :state, reason = :reason, detail = :detail,
    started_us = :started_us, ended_us = :ended_us
WHERE seq = :seq;

-- name: insert_event
INSERT INTO job_event (job, time_us, actor, state, reason, detail)
SELECT seq, :time_us, :actor, :state, :reason, :detail FROM job WHERE seq = :job;

-- name: last_seq
SELECT COALESCE((SELECT seq FROM sqlite_sequence WHERE name = 'job'), 0);

-- name: newest_jobs
SELECT seq, id, machine, program, commands, name, position, called, signals, state, reason, detail,
       created_us, started_us, ended_us
FROM job WHERE machine = :machine ORDER BY seq DESC LIMIT :most;

-- name: jobs_not_ended
SELECT seq, id, machine, program, commands, name, position, called, signals, state, reason, detail,
       created_us, started_us, ended_us
FROM job WHERE machine = :machine AND state IN ('pending', 'pending-held', 'processing', 'processing-stopped')
ORDER BY seq;

-- name: trim_jobs
DELETE FROM job
WHERE machine = :machine
  AND state IN ('canceled', 'aborted', 'completed')
  AND seq <= (SELECT seq FROM job WHERE machine = :machine ORDER BY seq DESC LIMIT 1 OFFSET :keep);

-- name: delete_job
DELETE FROM job WHERE seq = :seq AND state IN ('canceled', 'aborted', 'completed');

-- name: programs_in_use
SELECT DISTINCT program FROM job
WHERE state IN ('pending', 'pending-held', 'processing', 'processing-stopped');

-- name: set_setting
INSERT INTO machine_setting (machine, name, value) VALUES (:machine, :name, :value)
ON CONFLICT (machine, name) DO UPDATE SET value = excluded.value;

-- name: get_setting
SELECT value FROM machine_setting WHERE machine = :machine AND name = :name;

-- name: insert_key
INSERT INTO api_key (name, sha256, created_us) VALUES (:name, :sha256, :created_us);

-- name: delete_key
DELETE FROM api_key WHERE name = :name;

-- name: keys
SELECT name, sha256, created_us FROM api_key ORDER BY name;

-- name: namespaces
SELECT DISTINCT namespace FROM namespace_item ORDER BY namespace;

-- name: namespace_items
SELECT key, value FROM namespace_item WHERE namespace = :namespace ORDER BY key;

-- name: namespace_item
SELECT value FROM namespace_item WHERE namespace = :namespace AND key = :key;

-- name: namespace_totals
SELECT COUNT(*), COUNT(DISTINCT namespace), COALESCE(SUM(size), 0) FROM namespace_item;

-- name: set_namespace_item
INSERT INTO namespace_item (namespace, key, size, value) VALUES (:namespace, :key, :size, :value)
ON CONFLICT (namespace, key) DO UPDATE SET size = excluded.size, value = excluded.value;

-- name: delete_namespace_item
DELETE FROM namespace_item WHERE namespace = :namespace AND key = :key;
