from .transcripts import reading_scores as reading_scores
