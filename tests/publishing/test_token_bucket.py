"""So many at once, so many a second."""

from resonator_daemon.publishing.token_bucket import TokenBucket


def test_tokens_come_back_with_time_and_not_beyond_the_brim() -> None:
    now_s = [5.0]
    bucket = TokenBucket(3, 2.0, lambda: now_s[0])
    assert [bucket.try_acquire() for _ in range(4)] == [True, True, True, False]
    now_s[0] += 0.25
    assert not bucket.try_acquire()
    now_s[0] += 0.25
    assert [bucket.try_acquire(), bucket.try_acquire()] == [True, False]
    now_s[0] += 100.0
    assert [bucket.try_acquire() for _ in range(4)] == [True, True, True, False]
